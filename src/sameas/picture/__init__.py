"""The picture: objects that persist, from what many sources say over time, and its metrics where the truth is known.

:class:`Picture` is that of a whole span; :class:`Watch` goes from instant to instant, for live use, and
:class:`PlotPicture` from scan to scan where no source names what it shows.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
