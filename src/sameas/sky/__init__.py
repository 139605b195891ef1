"""The sky: star catalogues and CCD frames, turned into the records that the core identifies.

What to use when:

- two catalogues: :func:`sameas.match`; a :class:`Catalogue` with :class:`CatalogueOptions` to check the interpretation
  of the columns first;
- three or more catalogues: :func:`sameas.match_many`;
- a CCD frame and a catalogue: :func:`detect` the stars, :func:`solve` for the pointing and the identification;
- movers among the detections of several exposures: :func:`find_movers` in :class:`Detections`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
