"""Targets seen by sensors: sources described, their reports in one plane and at one instant, biases taken away.

Use :class:`Scene` where several sensors watch the same objects: describe each (:class:`Description`, or
:func:`read_descriptions` from a file), read what it wrote (:func:`sameas.io.sensors.read_reports`), and ask the scene
for an instant, which :func:`sameas.identify_many` understands.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
