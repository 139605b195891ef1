"""The sky: star catalogues and CCD frames, turned into the records that the core identifies.

What to use when:

- two catalogues: :func:`match` of two :class:`Catalogue`, and :func:`joined` for the table of both;
- three catalogues or more: :func:`match_many`, and :func:`joined_many`;
- a CCD frame and a catalogue: :func:`detect` its stars, :func:`solve` where it points and which star is which.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
