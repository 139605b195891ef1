"""Provenance: how an output was made, to be read by people and by ``sameas explain``."""

from __future__ import annotations

import math
import platform
from datetime import UTC, datetime
from typing import Any

import astropy
import numba
import numpy

import sameas
from sameas.cli.request import Request
from sameas.sky.match import SkyMatch


def provenance(request: Request, match: SkyMatch, command: str) -> dict[str, Any]:
    """A flat mapping of plain values; the same for the same inputs and options, but for date and paths."""
    result, estimate = match.result, match.estimate
    area, density_1, density_2 = match.area_and_densities
    return {
        "program": "sameas",
        "version": sameas.__version__,
        "command": command,
        "date_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "numba": numba.__version__,
        "astropy": astropy.__version__,
        **request.facts(),
        "name_1": match.first.name,
        "name_2": match.second.name,
        "rows_1": len(match.first),
        "rows_2": len(match.second),
        "used_1": len(result.first),
        "used_2": len(result.second),
        "epoch_1": match.first.epoch_jyr,
        "epoch_2": match.second.epoch_jyr,
        "common_epoch": match.epoch_jyr,
        "motion": match.moved,
        "offset": None if match.turn is None else str(match.turn),
        "area_deg2": area,
        "density_1_per_deg2": density_1,
        "density_2_per_deg2": density_2,
        "common_objects": estimate.common,
        "share_1": estimate.share_1,
        "share_2": estimate.share_2,
        "error_scales": list(estimate.errors.scales),
        "error_shares": list(estimate.errors.shares),
        "gate_sigmas": estimate.gate_sigmas,
        "rounds": estimate.rounds,
        **_quantities(match),
        "candidates": len(result.pairs),
        "pairs": len(result.matches),
        "expected_wrong": result.expected_wrong,
        "doubts": list(match.doubts),
    }


def _quantities(match: SkyMatch) -> dict[str, float]:
    """Everything estimated with its standard error, where it has one."""
    facts = {}
    for name, quantity in match.estimate.quantities.items():
        if math.isfinite(quantity.standard_error):
            facts[f"estimated_{name}"] = quantity.value
            facts[f"estimated_{name}_error"] = quantity.standard_error
    return facts
