"""Pages: one HTML file each that shows a result in a browser, without a network."""

from sameas.pages.frame import write_frame_page

__all__ = ["write_frame_page"]
