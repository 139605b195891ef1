"""Disjoint fields of two catalogues, and misreadings of positions that would explain them.

Hours read as degrees, swapped columns, another equinox: each is tried, and the one that brings the fields together is
named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Argument, Message
from sameas.records import Records
from sameas.sky.catalogue import Catalogue
from sameas.sky.celestial_frames import in_icrs
from sameas.sky.column_choice import ColumnChoice
from sameas.space import directions_deg, mean_direction, unit_vectors

#: Maximum number of records that determine a field: more hardly change its outline.
_MOST_RECORDS = 10_000
#: Minimum radius of a field, degrees, as for a catalogue of one row (chosen).
_LEAST_RADIUS_DEG = 0.05


@dataclass(frozen=True)
class _Field:
    """A circle on the sky around all records. centre (3,) : unit vector. radius_deg : to the farthest record."""

    centre: FloatArray
    radius_deg: float

    @classmethod
    def of(cls, position_deg: FloatArray) -> _Field:
        vectors = unit_vectors(*position_deg.T)
        centre = mean_direction(vectors)
        return cls(centre, max(float(_degrees(vectors @ centre).max()), _LEAST_RADIUS_DEG))

    def distance_deg(self, other: _Field) -> float:
        """Degrees from centre to centre."""
        return float(_degrees(self.centre @ other.centre))

    def __str__(self) -> str:
        lon, lat = directions_deg(self.centre)
        return f"within {self.radius_deg:.2g}° of RA {lon:.2f}°, Dec {lat:+.2f}°"


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


#: The end of a doubt about two fields that lie apart, if no misreading explains it.
WHETHER_SAME_SKY = ": do they show the same part of the sky?"


def disjoint_doubt(first: Catalogue, second: Catalogue, one: Records, two: Records) -> tuple[str, ...]:
    """One line if the fields of the catalogues do not overlap, with a misreading that would explain it.

    one, two : the records of the catalogues.
    """
    positions = [records.features[:: max(1, len(records) // _MOST_RECORDS)] for records in (one, two)]
    fields = [_Field.of(position) for position in positions]
    if fields[0].distance_deg(fields[1]) <= fields[0].radius_deg + fields[1].radius_deg:
        return ()
    text = f"the fields lie apart: {first.name} {fields[0]}, {second.name} {fields[1]}"
    sides = (2, second, positions[1], fields[0], first), (1, first, positions[0], fields[1], second)
    for side, catalogue, position, field, other in sides:
        for misread in _MISREADINGS:
            if misread.possible(catalogue.choice, position):
                corrected_field = _Field.of(misread.corrected(position))
                if corrected_field.distance_deg(field) <= max(corrected_field.radius_deg, field.radius_deg):
                    of = f"of {catalogue.name} would lie in the field of {other.name}: "
                    ra, dec = catalogue.choice.ra.name, catalogue.choice.dec.name
                    meaning = misread.meaning.format(ra=ra, dec=dec)
                    return (Message(f"{text}; {meaning} {of}", misread.remedy(ra, dec, side)),)
    return (f"{text}{WHETHER_SAME_SKY}",)


@dataclass(frozen=True)
class _Misreading:
    """One possible misreading of the position columns.

    possible : whether the columns and positions allow it. corrected : the positions after correction. meaning : text.
    remedy : what to do, given the names of the two columns and the side (1 or 2).
    """

    possible: Callable[[ColumnChoice, FloatArray], bool]
    corrected: Callable[[FloatArray], FloatArray]
    meaning: str
    remedy: Callable[[str, str, int], str]


def _no_unit(choice: ColumnChoice) -> bool:
    return choice.frame == "icrs" and choice.ra.unit == "deg" and choice.ra.reason == "by convention"


def _swapped(position_deg: FloatArray) -> FloatArray:
    return np.column_stack([position_deg[:, 1], (position_deg[:, 0] + 180.0) % 360.0 - 180.0])


_MISREADINGS = (
    _Misreading(
        lambda choice, at: choice.frame == "icrs",
        partial(in_icrs, "B1950"),
        "of the equinox B1950, {ra} and {dec}",
        lambda ra, dec, side: "call them ra1950 and dec1950",
    ),
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 24.0),
        lambda at: at * [15.0, 1.0],
        "in hours, {ra}",
        lambda ra, dec, side: f"give the column its unit, h, or call it '{ra} [h]'",
    ),
    _Misreading(
        lambda choice, at: _no_unit(choice) and bool(at[:, 0].max() <= 2.0 * np.pi),
        lambda at: np.degrees(at),
        "in radians, {ra} and {dec}",
        lambda ra, dec, side: f"give the columns their unit, rad, or call them '{ra} [rad]', '{dec} [rad]'",
    ),
    _Misreading(
        lambda choice, at: choice.ra.unit == "sexagesimal hours",
        lambda at: at / [15.0, 1.0],
        "in degrees instead of hours, {ra}",
        lambda ra, dec, side: "give the column its unit, deg",
    ),
    _Misreading(
        lambda choice, at: bool((np.abs(_swapped(at)[:, 1]) <= 90.0).all()),
        _swapped,
        "exchanged, {ra} and {dec}",
        lambda ra, dec, side: Message("give ", Argument(f"ra{side}", dec), " ", Argument(f"dec{side}", ra)),
    ),
    _Misreading(
        lambda choice, at: True,
        lambda at: at * [1.0, -1.0],
        "with the other sign, {dec}",
        lambda ra, dec, side: "were its signs lost?",
    ),
    _Misreading(
        lambda choice, at: choice.frame == "icrs",
        partial(in_icrs, "galactic"),
        "as galactic longitude and latitude, {ra} and {dec}",
        lambda ra, dec, side: "call them l and b",
    ),
)
