"""The sky: star catalogues and CCD frames, turned into the records that the core identifies.

What to use when:

- two catalogues: :func:`sameas.match`; a :class:`Catalogue` and its :class:`CatalogueOptions` where you want to look at
  what is understood before;
- three catalogues or more: :func:`sameas.match_many`;
- a CCD frame and a catalogue: :func:`detect` its stars, :func:`solve` where it points and which star is which;
- what moves among the detections of several exposures: :func:`find_movers` of :class:`Detections`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
