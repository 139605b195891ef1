"""The public names of the picture."""

from .live import LivePicture as LivePicture
from .memory import TrackMemory as TrackMemory
from .object_ids import Stages as Stages
from .picture import Picture as Picture
from .picture import instants as instants
from .picture import picture_states as picture_states
from .picture_state import PictureState as PictureState
from .plot_picture import PlotPicture as PlotPicture
from .previous_scans import PreviousScans as PreviousScans
from .summary import Summary as Summary
from .tuning import Tuning as Tuning
from .watch import Watch as Watch
from .watch import all_evidence as all_evidence
