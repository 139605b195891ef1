"""What does not stand still: asteroids and comets among the detections of several exposures.

The way of the data; each module hands on one frozen value:

- :mod:`~sameas.sky.movers.detections`: columns → ``Detections``, checked, exposures numbered by time;
- :mod:`~sameas.sky.movers.model`: ``Detections`` → ``Surroundings`` (densities, which exposures saw which place), and
  ``MotionModel``, what is believed of rates (:mod:`~sameas.sky.movers.model`), brightness and misses;
- :mod:`~sameas.sky.movers.links`: → ``Links``, which detection may be the next one of the same mover, one to one; its
  assignment, repeated, teaches the model (``learn``);
- :mod:`~sameas.sky.movers.tracks`: ``Links`` → ``Tracks`` grown along them → ``Competition`` of whole tracks for the
  detections, by set packing;
- :mod:`~sameas.sky.movers.search`: → ``Movers``, the tracklets with their probabilities (``find_movers``).
- :mod:`~sameas.sky.movers.trails`: what is left over of a tied series, measured as trails where it is one;
- :mod:`~sameas.sky.movers.search`: what a tied series of frames (:mod:`sameas.sky.series`) leaves over → ``Movers``;
- :mod:`~sameas.sky.movers.known`: ``Movers`` → scores of digest2 for near-Earth objects, where it is installed;
- :mod:`~sameas.sky.movers.known`: ``Movers`` and ``Elements`` (:mod:`~sameas.sky.movers.orbits`) → ``KnownObjects``.

When to use what: :func:`find_movers` of :class:`Detections` finds tracklets; :func:`learn_motion` of other nights gives
it a better model than one poor night can teach.
"""

from sameas.sky.movers.detections import Detections
from sameas.sky.movers.model import MotionModel
from sameas.sky.movers.search import Movers, find_movers, learn_motion

__all__ = ["Detections", "MotionModel", "Movers", "find_movers", "learn_motion"]
