"""Data sources of COMPASS: the sensors of a surveillance centre, as its configuration is exported to JSON.

A data source has a type, a name, SAC and SIC; a radar has its place, and may have standard deviations and ranges of its
primary and secondary radar and of Mode S. It becomes the table of a source, as :mod:`~sameas.io.sensors.sources` reads
them from TOML. Source: the COMPASS user manual, appendix "Data Sources", both versions of the format.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sameas.errors import InputError
from sameas.tracks.coordinates import MILE_M

#: Kind of source, by the type of a data source; others are known by their reports.
_KINDS = {"radar": "air radar", "adsb": "ads-b", "mlat": "wam", "tracker": "tracks", "reftraj": "tracks"}
#: The equipment of a radar whose numbers are taken, the first that it has: most plots of air traffic are of these.
_EQUIPMENT = ("mode_s", "secondary", "primary")


def tables_of(path: str | Path) -> dict[str, dict[str, Any]]:
    """The tables of the sources, by name: ``sac_sic``, ``kind``, ``site``, ``errors`` and ``coverage`` where known.

    Raises InputError: not JSON; no data sources; one without a name, SAC or SIC; two of one name.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({getattr(error, 'strerror', None) or error})") from error
    tables: dict[str, dict[str, Any]] = {}
    for kind, source in _sources(content):
        name = str(source.get("short_name") or source.get("name") or "")
        codes = [source.get("sac"), source.get("sic")]
        if not name or not all(isinstance(code, int) and 0 <= code <= 255 for code in codes):
            raise InputError(f"{path}: a data source has no name, SAC or SIC: {json.dumps(source)[:120]}")
        if name in tables:
            raise InputError(f"{path}: two data sources are called {name}", "give one of them another short_name")
        tables[name] = {"sac_sic": f"{codes[0]}/{codes[1]}", **_described(kind, source)}
    if not tables:
        raise InputError(
            f"{path}: is JSON without data sources",
            "export them from COMPASS (Configuration, Data Sources), or give TOML",
        )
    return tables


def _sources(content: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The data sources and their types; in the older version they are listed by type."""
    if not isinstance(content, Mapping):
        return
    current = content.get("data_sources")
    if isinstance(current, list):
        yield from ((str(one.get("ds_type", "")), one) for one in current if isinstance(one, Mapping))
        return
    for kind, listed in content.items():
        if isinstance(listed, list):
            yield from ((str(kind), one) for one in listed if isinstance(one, Mapping) and "sac" in one)


def _described(kind: str, source: Mapping[str, Any]) -> dict[str, Any]:
    info = source.get("info")
    # The older version has all numbers beside the name.
    info = info if isinstance(info, Mapping) else {}
    place, accuracy, ranges = (
        part if isinstance(part := info.get(name, source), Mapping) else {}
        for name in ("position", "radar_accuracy", "radar_range")
    )
    table: dict[str, Any] = {}
    if known := _KINDS.get(kind.lower().replace("-", "")):
        table["kind"] = known
    if isinstance(place.get("latitude"), (int, float)) and isinstance(place.get("longitude"), (int, float)):
        height_m = place.get("altitude")
        table["site"] = {
            "lat_deg": place["latitude"], "lon_deg": place["longitude"],
            "height_m": height_m if isinstance(height_m, (int, float)) else 0.0,
        }  # fmt: skip
    errors = {"range_m": _number(accuracy, "range_stddev"), "bearing_deg": _number(accuracy, "azimuth_stddev")}
    if errors := {name: value for name, value in errors.items() if value}:
        table["errors"] = errors
    if furthest_nm := _number(ranges, "ir_max"):
        table["coverage"] = {"range_m": furthest_nm * MILE_M}
    return table


def _number(part: Mapping[str, Any], name: str) -> float | None:
    """A number of the first equipment that has it."""
    values = (part.get(f"{equipment}_{name}") for equipment in _EQUIPMENT)
    return next((float(value) for value in values if isinstance(value, (int, float)) and value > 0), None)
