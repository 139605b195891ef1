"""Tracks: descriptions of sensors, their reports in one plane and at one instant, and the removal of their biases.

Use :class:`Scene` if several sensors observe the same objects: describe each (:class:`Description`, or
:func:`read_descriptions` from a file), read its reports (:func:`sameas.io.sensors.read_reports`), and pass the records
of an instant of the scene to :func:`sameas.identify_many`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
