"""Evidence: the likelihood ratio of a pair, if both records are one object over if they are two.

Every rule gives natural logarithms per pair, by term; rules add with ``+``.

- :class:`Field`: a different object lies anywhere with constant density (METHOD 3.1, the papers' uniform rule).
- :class:`PoissonField`: objects are a Poisson field; the densities of common and of unrelated objects are known or
  estimated (METHOD 4.3). The default for catalogues.
- :class:`ConstantCost`: frame and catalogue, every unmatched record costs the constant density C
  (METHOD 3.4 [F15–F17]); ``ConstantCost.calibrated`` is its form with a detection probability and the density of
  other measurements.
- :class:`CloseObjects`: a different object is near, but not nearer than two objects can be
  (METHOD 3.2 [T14–T19, T26]). For pictures of a few targets.
- :class:`Brightness`: magnitudes and colours, added to positions; ``sameas.match`` fits it to the
  :class:`Magnitudes` of both sources.
- :class:`Columns`: any columns of one source, added to other rules; ``sameas.match`` fits it to each :class:`Column`,
  and to :class:`Related` columns of both sources; an :class:`OddsTable` is a prior given by the user.
- :class:`Precision`: the sizes of both quoted errors, added to positions and magnitudes; ``sameas.match`` fits it.
- :class:`Identity`: addresses, callsigns, names, types, lengths, added to positions, each attribute with a model of its
  errors: :class:`Code`, :class:`Category`, :class:`Size`. :func:`alarms` finds one identity at two positions.
- :class:`Heights`: heights of aircraft, added to positions.
- :class:`Universal`: any density of objects and of their neighbours, as a mixture, samples or functions
  (METHOD 3.3 [T13]). Where the densities are known and are none of the above.
"""

from sameas.evidence.brightness import (
    Brightness,
    Chain,
    Comparison,
    Comparisons,
    MagnitudeDensity,
    Magnitudes,
    MeasuredMagnitudes,
    PartnerTilt,
    Pattern,
    Regressors,
    Relation,
    SourceMagnitudes,
    comparisons_of,
)
from sameas.evidence.close import CloseObjects, log_neighbour_density, log_surface_density
from sameas.evidence.columns import (
    Association,
    CodedColumn,
    Column,
    Columns,
    OddsTable,
    Precision,
    Related,
    TrainingPairs,
)
from sameas.evidence.fields import ConstantCost, DetectionField, Field, PoissonField
from sameas.evidence.heights import Heights
from sameas.evidence.identity import MODELS, Category, Code, Identity, IdentityConflict, Model, Size, alarms
from sameas.evidence.rule import Errors, Evidence, Rule, Sum
from sameas.evidence.universal import Displacement, Flat, GaussianMixture, Samples, Universal

__all__ = [
    "MODELS", "Association", "Brightness", "Category", "Chain", "CloseObjects", "Code", "CodedColumn",
    "Column", "Columns", "Comparison", "Comparisons", "ConstantCost", "DetectionField", "Displacement", "Errors",
    "Evidence", "Field", "Flat", "GaussianMixture", "Heights", "Identity", "IdentityConflict", "MagnitudeDensity",
    "Magnitudes", "MeasuredMagnitudes", "Model", "OddsTable", "PartnerTilt", "Pattern", "PoissonField", "Precision",
    "Regressors", "Related", "Relation", "Rule", "Samples", "Size", "SourceMagnitudes", "Sum", "TrainingPairs",
    "Universal", "alarms", "comparisons_of", "log_neighbour_density", "log_surface_density",
]  # fmt: skip
