"""Provenance: how an output was made, and what was estimated.

It is for people and for ``sameas explain``: flat mappings of plain values. Except for date and paths, they are the same
for the same inputs and options.
"""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import sameas

if TYPE_CHECKING:
    from sameas.estimate.result import Estimate
    from sameas.front.request import Request
    from sameas.result import Identification
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.internal import InternalMatch, InternalOptions
    from sameas.sky.many import ManyMatch, ManyOptions
    from sameas.sky.sky_match import SkyMatch
    from sameas.sky.systematics import Rotation

#: Names of the terms of the error model in an output.
ERROR_TERM_NAMES = {
    "factor_1": "error_factor_1",
    "factor_2": "error_factor_2",
    "both": "error_factor_both",
    "floor": "error_floor",
    "floor_instead": "error_floor_instead",
}


def program() -> dict[str, Any]:
    """Name and version of this program."""
    return {"program": "sameas", "version": sameas.__version__}


def made_by(command: str) -> dict[str, Any]:
    """Program, version and command."""
    return {**program(), "command": command}


def _made_now(command: str) -> dict[str, Any]:
    # SOURCE_DATE_EPOCH, if set, makes outputs reproducible byte for byte (reproducible-builds.org).
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(given), UTC) if re.fullmatch(r"\d{1,10}", given) else datetime.now(UTC)
    now = moment.strftime("%Y-%m-%dT%H:%M:%SZ")
    return made_by(command) | {"date_utc": now, "python": platform.python_version()}


def of_match(
    request: Request[MatchOptions], match: SkyMatch, command: str, words: Callable[[str], str]
) -> dict[str, Any]:
    """Provenance of a match of two catalogues. words : rewords messages that name arguments."""
    from importlib.metadata import version

    import astropy
    import numpy

    from sameas.sky.joins import joined_names

    result, estimate = match.result, match.estimate
    area, density_1, density_2 = match.area_and_densities
    return {
        **_made_now(command),
        "numpy": numpy.__version__,
        "numba": version("numba"),  # without importing it
        "astropy": astropy.__version__,
        **request.facts(),
        "name_1": match.first.name,
        "name_2": match.second.name,
        **_roles((match.first, match.second), joined_names([match.first.table, match.second.table])),
        "rows_1": len(match.first),
        "rows_2": len(match.second),
        "used_1": len(result.first),
        "used_2": len(result.second),
        "epoch_1": match.first.epoch_jyr,
        "epoch_2": match.second.epoch_jyr,
        "common_epoch": match.epoch_jyr,
        "motion": match.moved,
        **_offset(match),
        "area_deg2": area,
        "density_1_per_deg2": density_1,
        "density_2_per_deg2": density_2,
        **_estimates(estimate),
        "evidence_error_floor_arcsec": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "rounds": estimate.iterations,
        "settled": estimate.converged,
        **_quantities(match),
        "error_note": (estimate.error_model.note or None) if estimate.error_model is not None else None,
        **_completeness(match),
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": [words(doubt) for doubt in match.doubts],
    }


def _estimates(estimate: Estimate) -> dict[str, Any]:
    """Estimates of two sources that have no unit."""
    return {
        "common_objects": estimate.common,
        "share_1": estimate.share_1,
        "share_2": estimate.share_2,
        "error_scales": list(estimate.spread.scales),
        "error_shares": list(estimate.spread.shares),
        "evidence_error_factor_1": estimate.errors.factor_1,
        "evidence_error_factor_2": estimate.errors.factor_2,
        **({"evidence_error_trends": trends} if (trends := _trends(estimate)) else {}),
        **({"evidence_resolution": f"source {r.coarse + 1}: {r.separation:.4g}"} if (r := estimate.resolution) else {}),
    }


def _trends(estimate: Estimate) -> list[str]:
    """The quantities that errors grow with, in words."""
    scale = estimate.errors.typical_scale
    return [trend.words(f"source {trend.source + 1}", scale) for trend in estimate.trends]


def _roles(catalogues: Sequence[Catalogue], names: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The columns of the joined table that hold id, position and magnitude of each catalogue; None if it has none.

    names : of each catalogue's columns in the joined table.
    """
    facts: dict[str, Any] = {}
    for k, (catalogue, joined) in enumerate(zip(catalogues, names, strict=True), 1):
        name_in_output = dict(zip(catalogue.table.colnames, joined, strict=True))
        choice = catalogue.choice
        numbered = any("rows are numbered" in line for line in catalogue.interpretation)
        roles = {"id": None if numbered else choice.id, "ra": choice.ra.name, "dec": choice.dec.name,
                 "magnitude": choice.magnitude}  # fmt: skip
        facts |= {f"{role}_column_{k}": None if name is None else name_in_output[name] for role, name in roles.items()}
    return facts


def of_records(result: Identification, estimate: Estimate, command: str) -> dict[str, Any]:
    """Provenance of a match of two ``Records``."""
    return {
        **_made_now(command),
        "name_1": result.first.source,
        "name_2": result.second.source,
        "rows_1": result.first.n_table,
        "rows_2": result.second.n_table,
        "used_1": len(result.first),
        "used_2": len(result.second),
        **_estimates(estimate),
        "evidence_error_floor": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": list(estimate.notes),
    }


def _offset(match: SkyMatch) -> dict[str, Any]:
    """The offset removed from the second catalogue: in words; east, north and rotation with errors, arcsec."""
    warp = {} if match.warp is None else {"offset_warp": str(match.warp), "offset_warp_order": match.warp.order}
    if match.rotation is None:
        return {"offset": None, **warp}
    return {f"offset{name}": value for name, value in _rotation_values(match.rotation).items()} | warp


def _rotation_values(rotation: Rotation) -> dict[str, Any]:
    """A rotation as plain values, by the suffix of their names."""
    return {
        "": str(rotation),
        "_centre_deg": list(rotation.centre_deg),
        "_arcsec": rotation.vector.tolist(),
        "_arcsec_error": rotation.standard_errors.tolist(),
    }


def _quantities(match: SkyMatch) -> dict[str, float]:
    """All estimates that have a standard error, with it."""
    estimate = match.estimate
    quantities = dict(estimate.quantities)
    if estimate.tail is not None:
        quantities["error_tail_share"] = estimate.tail.share
    if estimate.error_model is not None:
        quantities |= {ERROR_TERM_NAMES[name]: quantity for name, quantity in estimate.error_model.terms.items()}
    facts = {}
    for name, quantity in quantities.items():
        if math.isfinite(quantity.standard_error):
            facts[f"estimated_{name}"] = quantity.value
            facts[f"estimated_{name}_error"] = quantity.standard_error
    return facts


def of_many(
    request: Request[ManyOptions], match: ManyMatch, command: str, words: Callable[[str], str]
) -> dict[str, Any]:
    """Provenance of a match of several catalogues. words : rewords messages that name arguments."""
    from sameas.sky.joins import joined_names

    facts, given = _made_now(command), request.facts()
    for k, catalogue in enumerate(match.catalogues, 1):
        facts |= {name: given[name] for name in (f"input_{k}", f"sha256_{k}")}
        facts |= {f"name_{k}": catalogue.name, f"rows_{k}": len(catalogue), f"epoch_{k}": catalogue.epoch_jyr}
        facts[f"options_{k}"] = given[f"options_{k}"]
    facts |= _roles(match.catalogues, joined_names([catalogue.table for catalogue in match.catalogues]))
    facts |= {"options_match": given["options_match"], "epoch_object": match.epoch_jyr}
    for k, catalogue in enumerate(match.catalogues, 1):
        if catalogue.name in match.rotations:
            removed = _rotation_values(match.rotations[catalogue.name])
            facts |= {f"offset{name}_{k}": value for name, value in removed.items()}
    facts |= {f"expected_{'_'.join(names)}": expected for names, expected in match.expected.items()}
    doubts = [words(doubt) for doubt in match.doubts]
    return facts | {"objects": len(match.objects), "rounds": match.iterations, "doubts": doubts}


def of_internal(
    request: Request[InternalOptions], match: InternalMatch, command: str, words: Callable[[str], str]
) -> dict[str, Any]:
    """Provenance of an internal match. words : rewords messages that name arguments."""
    facts, given = _made_now(command), request.facts()
    facts |= {name: given[name] for name in ("input_1", "sha256_1")}
    facts |= {"name_1": match.catalogue.name, "rows_1": len(match.catalogue), "options_1": given["options_1"]}
    facts |= {"options_match": given["options_match"], "reach_arcsec": match.reach_arcsec, "objects": len(match)}
    facts |= _roles((match.catalogue,), (match.catalogue.table.colnames,))
    return facts | {"doubts": [words(doubt) for doubt in match.doubts]}


def _completeness(match: SkyMatch) -> dict[str, Any]:
    """By magnitude: the share of each catalogue that the other one detects, and the density of undetected objects."""
    from sameas.sky.sky_match import ARCSEC2_PER_DEG2

    facts: dict[str, Any] = {}
    for side, curve in ((1, match.estimate.detection_1), (2, match.estimate.detection_2)):
        if curve is not None:
            facts |= {
                f"completeness_{side}_band": curve.band,
                f"completeness_{side}_edges_mag": curve.edges.tolist(),
                f"completeness_{side}": curve.probability.tolist(),
                f"completeness_{side}_error": curve.standard_error.tolist(),
                f"density_only_{side}_per_deg2_mag": (ARCSEC2_PER_DEG2 * curve.density).tolist(),
                f"density_only_{side}_per_deg2_mag_error": (ARCSEC2_PER_DEG2 * curve.density_error).tolist(),
            }
    return facts
