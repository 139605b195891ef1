"""The picture: persistent objects from the reports of many sources over time.

Use :class:`Picture` for a whole time span, :class:`Watch` from instant to instant for live use, and
:class:`PlotPicture` from scan to scan if no source has track ids.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
