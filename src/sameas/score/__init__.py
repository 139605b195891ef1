"""Scores of an answer against the truth, and the simpler answers (baselines) that it has to beat.

What to use when:

- pairs and records right, wrong and missed: :func:`score_pairs`, :func:`score_records`;
- are stated probabilities frequencies: :func:`score_probabilities`, :func:`reliability`;
- positions found and missed, as one distance: :func:`gospa`;
- a picture over time, by its identities: :func:`pair_score`, :func:`siap`, :func:`majority_votes`, :func:`nees`;
- what nearest neighbour, mutual nearest and others would say: :func:`nearest`, :func:`mutual_nearest`,
:func:`most_pairs`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
