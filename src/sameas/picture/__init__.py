"""The picture: objects that persist, from what many sources say over time, and its metrics where the truth is known.

:class:`Picture` is that of a whole span; :class:`Watch` goes from instant to instant, for live use, and
:class:`Lookout` from look to look where no source names what it shows.
"""

from sameas.picture.lookout import Lookout
from sameas.picture.memory import Memory, Past
from sameas.picture.moment import Moment, Watch, all_that_is_said
from sameas.picture.numbering import Stages
from sameas.picture.picture import Picture, instants, moments
from sameas.picture.summary import Summary

__all__ = [
    "Lookout",
    "Memory",
    "Moment",
    "Past",
    "Picture",
    "Stages",
    "Summary",
    "Watch",
    "all_that_is_said",
    "instants",
    "moments",
]
