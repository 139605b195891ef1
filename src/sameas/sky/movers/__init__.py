"""Movers: asteroids and comets among the detections of several exposures.

The data flow; each module returns one frozen value:

- :mod:`~sameas.sky.movers.detections`: columns → ``Detections``, checked, exposures numbered by time;
- :mod:`~sameas.sky.movers.stationary`: ``Detections`` → ``Stationary``: the stationary sources, with the offsets of the
  exposures and the error scale; and the detections fixed on a dithered chip;
- :mod:`~sameas.sky.movers.model`: the rest → ``Surroundings`` (densities, which exposures cover which position), and
  ``MotionModel``, the model of rates (:mod:`~sameas.sky.movers.rates`), brightness and misses;
- :mod:`~sameas.sky.movers.links`: → ``Links``, which detection may be the next one of the same mover, one to one; its
  iterated assignment estimates the model (``learn``);
- :mod:`~sameas.sky.movers.tracks`: ``Links`` → ``Tracks`` grown along them → ``Competition`` of whole tracks for the
  detections, by set packing;
- :mod:`~sameas.sky.movers.search`: → ``Movers``, the tracklets with their probabilities: of detections
  (``find_movers``), and of the unexplained measurements of a series of frames (:mod:`sameas.sky.series`) (``search``);
- :mod:`~sameas.sky.movers.trails`: trails among these measurements; :mod:`~sameas.sky.movers.stack` and
  :mod:`~sameas.sky.movers.below_limit`: the frames stacked along a motion;
- :mod:`~sameas.sky.movers.known`: ``Movers`` and ``Elements`` (:mod:`~sameas.sky.movers.orbits`) → ``KnownObjects``,
  and digest2 scores for near-Earth objects, if it is installed.

When to use what: :func:`find_movers` finds tracklets in :class:`Detections`; :func:`learn_motion` of other nights gives
it a better model than one poor night alone.
"""

from sameas.sky.movers.detections import Detections
from sameas.sky.movers.model import MotionModel
from sameas.sky.movers.search import Movers, find_movers, learn_motion

__all__ = ["Detections", "MotionModel", "Movers", "find_movers", "learn_motion"]
