"""What does not stand still: asteroids and comets among the detections of several exposures.

The way of the data; each module hands on one frozen value:

- :mod:`~sameas.sky.movers.detections`: columns → ``Detections``, checked, exposures numbered by time;
- :mod:`~sameas.sky.movers.stationary`: ``Detections`` → ``Stationary``: the sources that do not move, with exposures'
  offsets and the scale of the errors that they show; and what is fixed on a dithered chip;
- :mod:`~sameas.sky.movers.model`: the rest → ``Surroundings`` (densities, which exposures saw which place), and
  ``MotionModel``, what is believed of rates (:mod:`~sameas.sky.movers.rates`), brightness and misses;
- :mod:`~sameas.sky.movers.links`: → ``Links``, which detection may be the next one of the same mover, one to one; its
  assignment, repeated, teaches the model (``learn``);
- :mod:`~sameas.sky.movers.tracks`: ``Links`` → ``Tracks`` grown along them → ``Competition`` of whole tracks for the
  detections, by set packing;
- :mod:`~sameas.sky.movers.search`: → ``Movers``, the tracklets with their probabilities: of detections
  (``find_movers``), and of what a tied series of frames (:mod:`sameas.sky.series`) leaves over (``search``);
- :mod:`~sameas.sky.movers.stack`: of that, what is measured better as a trail; :mod:`~sameas.sky.movers.stack` and
  :mod:`~sameas.sky.movers.below_limit`: what the frames show along a motion;
- :mod:`~sameas.sky.movers.known`: ``Movers`` and ``Elements`` (:mod:`~sameas.sky.movers.orbits`) → ``KnownObjects``,
  and scores of digest2 for near-Earth objects, where it is installed.

When to use what: :func:`find_movers` of :class:`Detections` finds tracklets; :func:`learn_motion` of other nights gives
it a better model than one poor night can teach.
"""

from sameas.sky.movers.detections import Detections
from sameas.sky.movers.model import MotionModel
from sameas.sky.movers.search import Movers, find_movers, learn_motion

__all__ = ["Detections", "MotionModel", "Movers", "find_movers", "learn_motion"]
