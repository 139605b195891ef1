"""Scores of an answer against the truth, and the simpler answers (baselines) that it has to beat.

What to use when:

- right, wrong and missed pairs and records: :func:`score_pairs`, :func:`score_records`;
- calibration of the stated probabilities: :func:`score_probabilities`, :func:`reliability`;
- positions, missed and false objects as one distance: :func:`gospa`;
- identities and states of a picture over time: :func:`pair_score`, :func:`siap`, :func:`majority_votes`, :func:`nees`;
- the answers of nearest neighbour, mutual nearest and other baselines: :func:`nearest`, :func:`mutual_nearest`,
  :func:`most_pairs`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
