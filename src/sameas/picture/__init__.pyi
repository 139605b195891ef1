"""The public names of the picture."""

from .memory import Memory as Memory
from .memory import Past as Past
from .object_ids import Stages as Stages
from .picture import Picture as Picture
from .picture import instants as instants
from .picture import moments as moments
from .picture_state import PictureState as PictureState
from .plot_picture import PlotPicture as PlotPicture
from .summary import Summary as Summary
from .watch import Watch as Watch
from .watch import all_that_is_said as all_that_is_said
