"""The public names of tracks."""

from .coordinates import LocalPlane as LocalPlane
from .feed import Feed as Feed
from .kinds import KINDS as KINDS
from .live_feed import LiveFeed as LiveFeed
from .registration import SourceBiases as SourceBiases
from .reports import Reports as Reports
from .scene import POSITION as POSITION
from .scene import POSITION_AND_VELOCITY as POSITION_AND_VELOCITY
from .scene import Instant as Instant
from .scene import Scene as Scene
from .source import BiasPrior as BiasPrior
from .source import Clutter as Clutter
from .source import Description as Description
from .source import KnownBiases as KnownBiases
from .source import MissRate as MissRate
from .source import Motion as Motion
from .source import Platform as Platform
from .source import Resolution as Resolution
from .source import SensorCoverage as SensorCoverage
from .source import SensorErrors as SensorErrors
from .source import Site as Site
from .source import Targets as Targets
from .source import Timing as Timing
from .source import read_descriptions as read_descriptions
