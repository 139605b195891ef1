"""Pages: one HTML file each that shows a result in a browser, without a network."""

from sameas.pages.frame import write_frame_page
from sameas.pages.map import write_map_page

__all__ = ["write_frame_page", "write_map_page"]
