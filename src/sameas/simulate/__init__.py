"""Simulated scenes with known truth, for testing a method before using it on real data.

What to use when:

- records of two sources: :func:`poisson_field`, :func:`line`, :func:`grid`, :func:`sky_field`, :func:`crowded_sky`;
- few sources with large errors in a deep catalogue, with magnitudes and colours: :func:`counterparts`;
- a CCD frame, pixel by pixel: :func:`frame_of_sky` of a :class:`Camera`;
- radars and transponders that observe moving targets: :class:`Sensor`, :class:`Tracker` on :class:`TrueMotion`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
