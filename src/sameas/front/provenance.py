"""Provenance: how an output was made, to be read by people and by ``sameas explain``.

Flat mappings of plain values; the same for the same inputs and options, but for date and paths.
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
    from sameas.estimate.match import Estimate
    from sameas.front.request import Request
    from sameas.result import Identification
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions, SkyMatch
    from sameas.sky.many import ManyMatch, ManyOptions
    from sameas.sky.systematics import Rotation

#: What the terms of the error model are called in an output.
ERROR_NAMES = {
    "factor_1": "error_factor_1",
    "factor_2": "error_factor_2",
    "both": "error_factor_both",
    "floor": "error_floor",
    "floor_instead": "error_floor_instead",
}


def program() -> dict[str, Any]:
    """Which program."""
    return {"program": "sameas", "version": sameas.__version__}


def made_by(command: str) -> dict[str, Any]:
    """Which program, and as what command."""
    return {**program(), "command": command}


def _made_now(command: str) -> dict[str, Any]:
    # The date that reproducible builds give (reproducible-builds.org): the same command then writes the same bytes.
    given = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(given), UTC) if re.fullmatch(r"\d{1,10}", given) else datetime.now(UTC)
    now = moment.strftime("%Y-%m-%dT%H:%M:%SZ")
    return made_by(command) | {"date_utc": now, "python": platform.python_version()}


def of_match(
    request: Request[MatchOptions], match: SkyMatch, command: str, words: Callable[[str], str] = str
) -> dict[str, Any]:
    """How the table of two catalogues was made. words : how a message that names arguments is put."""
    from importlib.metadata import version

    import astropy
    import numpy

    from sameas.sky.joins import joined_names

    result, estimate = match.result, match.estimate
    area, density_1, density_2 = match.area_and_densities
    return {
        **_made_now(command),
        "numpy": numpy.__version__,
        "numba": version("numba"),  # it may not have been needed
        "astropy": astropy.__version__,
        **request.facts(),
        "name_1": match.first.name,
        "name_2": match.second.name,
        **_roles((match.first, match.second), joined_names(match.first.table, match.second.table)),
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
        **_learned(estimate),
        "evidence_error_floor_arcsec": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "rounds": estimate.rounds,
        "settled": estimate.settled,
        **_quantities(match),
        "error_note": (estimate.error_model.note or None) if estimate.error_model is not None else None,
        **_completeness(match),
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": [words(doubt) for doubt in match.doubts],
    }


def _learned(estimate: Estimate) -> dict[str, Any]:
    """What was estimated of two sources, whatever their unit."""
    return {
        "common_objects": estimate.common,
        "share_1": estimate.share_1,
        "share_2": estimate.share_2,
        "error_scales": list(estimate.spread.scales),
        "error_shares": list(estimate.spread.shares),
        "evidence_error_factor_1": estimate.errors.factor_1,
        "evidence_error_factor_2": estimate.errors.factor_2,
        **({"evidence_error_trends": trends} if (trends := _trends(estimate)) else {}),
    }


def _trends(estimate: Estimate) -> list[str]:
    """What errors grow with, beside these factors, in words."""
    scale = estimate.errors.typical_scale
    return [trend.words(f"source {trend.source + 1}", scale) for trend in estimate.trends]


def _roles(catalogues: Sequence[Catalogue], names: Sequence[Sequence[str]]) -> dict[str, Any]:
    """By which columns of the joined table a record is found again; None where its catalogue has none.

    names : of the columns of every catalogue in the joined table.
    """
    facts: dict[str, Any] = {}
    for k, (catalogue, joined) in enumerate(zip(catalogues, names, strict=True), 1):
        called = dict(zip(catalogue.table.colnames, joined, strict=True))
        choice = catalogue.choice
        numbered = any("rows are numbered" in line for line in catalogue.interpretation)
        roles = {"id": None if numbered else choice.id, "ra": choice.ra.name, "dec": choice.dec.name,
                 "magnitude": choice.magnitude}  # fmt: skip
        facts |= {f"{role}_column_{k}": None if name is None else called[name] for role, name in roles.items()}
    return facts


def of_records(result: Identification, estimate: Estimate, command: str) -> dict[str, Any]:
    """How the table of two sources of records was made."""
    return {
        **_made_now(command),
        "name_1": result.first.source,
        "name_2": result.second.source,
        "rows_1": result.first.n_table,
        "rows_2": result.second.n_table,
        "used_1": len(result.first),
        "used_2": len(result.second),
        **_learned(estimate),
        "evidence_error_floor": estimate.errors.floor,
        "gate_sigmas": estimate.gate_sigmas,
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": list(estimate.notes),
    }


def _offset(match: SkyMatch) -> dict[str, Any]:
    """What was taken away from the second catalogue: in words, and east, north and turn with their errors, arcsec."""
    warp = {} if match.warp is None else {"offset_warp": str(match.warp), "offset_warp_order": match.warp.order}
    if match.rotation is None:
        return {"offset": None, **warp}
    return {f"offset{name}": value for name, value in _taken_away(match.rotation).items()} | warp


def _taken_away(rotation: Rotation) -> dict[str, Any]:
    """A rotation as plain values, by the ending of their names."""
    return {
        "": str(rotation),
        "_centre_deg": list(rotation.centre_deg),
        "_arcsec": rotation.vector.tolist(),
        "_arcsec_error": rotation.standard_errors.tolist(),
    }


def _quantities(match: SkyMatch) -> dict[str, float]:
    """Everything estimated with its standard error, where it has one."""
    estimate = match.estimate
    found = dict(estimate.quantities)
    if estimate.tail is not None:
        found["error_tail_share"] = estimate.tail.share
    if estimate.error_model is not None:
        found |= {ERROR_NAMES[name]: quantity for name, quantity in estimate.error_model.terms.items()}
    facts = {}
    for name, quantity in found.items():
        if math.isfinite(quantity.standard_error):
            facts[f"estimated_{name}"] = quantity.value
            facts[f"estimated_{name}_error"] = quantity.standard_error
    return facts


def of_many(
    request: Request[ManyOptions], match: ManyMatch, command: str, words: Callable[[str], str] = str
) -> dict[str, Any]:
    """How the table of several catalogues was made. words : how a message that names arguments is put."""
    from sameas.sky.many.joins import joined_names as joined_many_names

    facts, given = _made_now(command), request.facts()
    for k, catalogue in enumerate(match.catalogues, 1):
        facts |= {name: given[name] for name in (f"input_{k}", f"sha256_{k}")}
        facts |= {f"name_{k}": catalogue.name, f"rows_{k}": len(catalogue), f"epoch_{k}": catalogue.epoch_jyr}
        facts[f"options_{k}"] = given[f"options_{k}"]
    facts |= _roles(match.catalogues, joined_many_names(match))
    facts |= {"options_match": given["options_match"], "epoch_object": match.epoch_jyr}
    for k, catalogue in enumerate(match.catalogues, 1):
        if catalogue.name in match.rotations:
            taken = _taken_away(match.rotations[catalogue.name])
            facts |= {f"offset{name}_{k}": value for name, value in taken.items()}
    facts |= {f"expected_{'_'.join(names)}": expected for names, expected in match.expected.items()}
    doubts = [words(doubt) for doubt in match.doubts]
    return facts | {"objects": len(match.objects), "rounds": match.iterations, "doubts": doubts}


def _completeness(match: SkyMatch) -> dict[str, Any]:
    """By magnitude: the share of either catalogue that the other shows, and the density of those it does not show."""
    from sameas.sky.crossmatch import ARCSEC2_PER_DEG2

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
