"""What ``sameas picture`` writes: tables, GeoJSON, a map, an image and a summary, into a folder and all at once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sameas.cli.provenance import made_by
from sameas.cli.terminal import notice
from sameas.errors import InputError
from sameas.io import checksum
from sameas.io.sensors.sources import SensorSource
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet
from sameas.picture.picture import Picture
from sameas.report.picture import listed
from sameas.tracks.registration import SourceBiases

#: Every file that may be written, without the extension of the tables.
TABLES = ("objects", "identities")
OTHERS = ("objects.geojson", "summary.json", "map.html", "picture.png")


@dataclass(frozen=True)
class Outputs:
    """What the user wants to have. format : of the tables. command : as it was typed."""

    folder: Path
    format: str
    map: bool
    image: bool
    command: str


@dataclass(frozen=True)
class Made:
    """A picture, what it was made of, and what is in doubt of its sources as a whole."""

    picture: Picture
    sources: Sequence[SensorSource]
    biases: Sequence[SourceBiases]
    doubts: Sequence[str]

    def facts(self, command: str) -> dict[str, Any]:
        """How the outputs were made: the same for the same command on the same files."""
        files = list(dict.fromkeys(source.path for source in self.sources))
        return made_by(command) | {
            "files": [str(path) for path in files], "sha256": [checksum(path) for path in files],
        }  # fmt: skip

    def told(self) -> dict[str, Any]:
        """The summary as JSON has it."""
        said = self.picture.summary
        return {
            "sources": [_source(source) for source in self.sources],
            "instants": said.instants, "first_s": said.first_s, "last_s": said.last_s,
            "confirmed_objects_by_number_of_sources": list(said.by_sources), "unconfirmed_objects": said.unconfirmed,
            "objects_per_instant": said.shown, "expected_wrong_per_instant": said.expected_wrong,
            "ambiguous_groups_per_instant": said.ambiguous_groups, "places": asdict(said.places),
            "alarms": [str(alarm) for alarm in said.alarms], "doubts": [*self.doubts, *said.notes],
            "offsets": [_offset(found) for found in self.biases], "misses": [asdict(misses) for misses in said.misses],
            "assumed": [asdict(line) for source in self.sources for line in source.description.assumed],
        }  # fmt: skip

    def sheet(self) -> MapSheet:
        """What a map shows of it."""
        picture, plane = self.picture, self.picture.plane
        sensors = [MapSensor.of(source.description, plane, source.path.name) for source in self.sources]
        title = "Picture of " + listed([source.description.name for source in self.sources])
        return MapSheet.of(
            title, picture.objects, picture.records, instants_s=picture.instants_s, sensors=sensors, plane=plane,
            summary=[*(f"doubt: {doubt}" for doubt in self.doubts), *picture.summary.lines()],
            alarms=list(_map_alarms(picture)), texts=picture.texts,
        )  # fmt: skip


def write(made: Made, draft: Path, outputs: Outputs) -> list[str]:
    """Writes everything that is wanted into a folder; the names of the files."""
    from astropy.table import Table

    from sameas.io import write_table
    from sameas.io.geojson import write_geojson

    picture, facts = made.picture, made.facts(outputs.command)
    written = []
    for name, columns in zip(TABLES, (picture.objects, picture.records), strict=True):
        written.append(f"{name}.{outputs.format}")
        write_table(Table(dict(columns)), draft / written[-1], provenance=facts, format=outputs.format)
    if picture.plane is not None:
        written.append("objects.geojson")
        write_geojson(picture.objects, draft / written[-1])
    written.append("summary.json")
    (draft / written[-1]).write_text(json.dumps(facts | made.told(), indent=1, ensure_ascii=False) + "\n", "utf-8")
    if outputs.map or outputs.image:
        written += _drawn(made, draft, outputs)
    return written


def older(folder: Path, written: Sequence[str]) -> list[str]:
    """Files of an earlier picture that are still in the folder and are not of this one."""
    known = [*(f"{name}.{extension}" for name in TABLES for extension in ("parquet", "csv")), *OTHERS]
    return [name for name in known if name not in written and (folder / name).exists()]


def fullest(picture: Picture) -> float:
    """The last of the instants at which most sources speak."""
    records = picture.records
    sources = [len(np.unique(records["source"][records["time_s"] == t])) for t in picture.instants_s]
    return float(picture.instants_s[np.flatnonzero(np.array(sources) == max(sources))[-1]])


def _drawn(made: Made, draft: Path, outputs: Outputs) -> Iterator[str]:
    """The map and the image; their names."""
    shown = made.sheet()
    if outputs.map:
        from sameas.pages.map import write_map_page

        write_map_page(shown, draft / "map.html")
        yield "map.html"
    if outputs.image:
        with _optional_plots():
            from sameas.plots.map import chart
            from sameas.plots.sheet import save

            save(chart(shown, fullest(made.picture)), draft / "picture.png")
            yield "picture.png"


@contextmanager
def _optional_plots() -> Iterator[None]:
    """Without matplotlib there is no image, which is said; the rest is there."""
    try:
        yield
    except InputError as error:
        if "matplotlib" not in str(error):
            raise
        notice(f"no picture.png: {error}")


def _map_alarms(picture: Picture) -> Iterator[MapAlarm]:
    """The alarms, with the objects that their records were."""
    records = picture.records
    for found in picture.summary.alarms:
        about = np.zeros(len(records["row"]), bool)
        for source, row in (found.alarm.first, found.alarm.second):
            about |= (records["source"] == source) & (records["row"] == row)
        yield MapAlarm(str(found), found.first_s, tuple(np.unique(records["object"][about]).tolist()))


def _source(source: SensorSource) -> dict[str, Any]:
    reports, damaged = source.reports, source.reports.damaged
    return {
        "name": source.description.name, "kind": source.description.kind, "kind_guessed": source.why_kind,
        "file": str(source.path), "format": reports.kind, "positions": reports.position, "reports": len(reports),
        "damaged": damaged.counts(), "passed_over": dict(reports.passed_over), "notes": list(reports.notes),
    }  # fmt: skip


def _offset(found: SourceBiases) -> dict[str, Any]:
    return {
        "source": found.source, "against": list(found.against), "established": found.established,
        "parameters": {name: asdict(it) for name, it in found.parameters.items()}, "words": list(found.lines()),
    }  # fmt: skip
