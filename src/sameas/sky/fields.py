"""Whether the fields of two catalogues meet, and what would make them: hours taken for degrees, columns exchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Argument, Message
from sameas.records import Records
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import ColumnChoice
from sameas.sky.column_values import to_icrs
from sameas.space import unit_vectors

#: Records that a field is judged by, at most: its outline moves by little with more.
_ENOUGH = 10_000
#: Radii below this, in degrees, count as this: of a catalogue of one row (chosen).
_LEAST_RADIUS_DEG = 0.05


@dataclass(frozen=True)
class _Field:
    """A circle on the sky that holds all records. centre (3,) : unit vector. radius_deg : to the farthest record."""

    centre: FloatArray
    radius_deg: float

    @classmethod
    def of(cls, position_deg: FloatArray) -> _Field:
        vectors = unit_vectors(*position_deg.T)
        middle = vectors.mean(axis=0)
        length = float(np.linalg.norm(middle))
        centre = middle / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
        return cls(centre, max(float(_degrees(vectors @ centre).max()), _LEAST_RADIUS_DEG))

    def to(self, other: _Field) -> float:
        """Degrees from centre to centre."""
        return float(_degrees(self.centre @ other.centre))

    def __str__(self) -> str:
        lon = np.degrees(np.arctan2(self.centre[1], self.centre[0])) % 360.0
        return f"within {self.radius_deg:.2g}° of RA {lon:.2f}°, Dec {np.degrees(np.arcsin(self.centre[2])):+.2f}°"


def _degrees(cosine: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def apart_doubts(first: Catalogue, second: Catalogue, one: Records, two: Records) -> tuple[str, ...]:
    """One line where no record of one catalogue lies in the field of the other, with a misreading that explains it.

    one, two : their records.
    """
    positions = [records.features[:: max(1, len(records) // _ENOUGH)] for records in (one, two)]
    fields = [_Field.of(position) for position in positions]
    if fields[0].to(fields[1]) <= fields[0].radius_deg + fields[1].radius_deg:
        return ()
    said = f"the fields lie apart: {first.name} {fields[0]}, {second.name} {fields[1]}"
    sides = (2, second, positions[1], fields[0], first), (1, first, positions[0], fields[1], second)
    for side, catalogue, position, field, other in sides:
        for misread in _MISREADINGS:
            if misread.fits(catalogue.choice, position):
                meant = _Field.of(misread.correct(position))
                if meant.to(field) <= max(meant.radius_deg, field.radius_deg):
                    of = f"of {catalogue.name} would lie in the field of {other.name}: "
                    ra, dec = catalogue.choice.ra.name, catalogue.choice.dec.name
                    return (
                        Message(f"{said}; {misread.meant.format(ra=ra, dec=dec)} {of}", misread.remedy(ra, dec, side)),
                    )
    return (f"{said}: do they show the same part of the sky?",)


@dataclass(frozen=True)
class _Misreading:
    """What a table may mean instead.

    fits : whether it may, by its columns and positions. correct : the positions if so. meant : in words.
    remedy : what to do, for the columns of right ascension and declination of a side.
    """

    fits: Callable[[ColumnChoice, FloatArray], bool]
    correct: Callable[[FloatArray], FloatArray]
    meant: str
    remedy: Callable[[str, str, int], str]


def _no_unit(choice: ColumnChoice) -> bool:
    return choice.frame == "icrs" and choice.ra.unit == "deg" and choice.ra.reason == "by convention"


def _of_galactic(position_deg: FloatArray) -> FloatArray:
    ra, dec, _ = to_icrs("galactic", *position_deg.T)
    return np.column_stack([ra, dec])


def _exchanged(position_deg: FloatArray) -> FloatArray:
    return np.column_stack([position_deg[:, 1], (position_deg[:, 0] + 180.0) % 360.0 - 180.0])


_MISREADINGS = (
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
        lambda choice, at: bool((np.abs(_exchanged(at)[:, 1]) <= 90.0).all()),
        _exchanged,
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
        _of_galactic,
        "as galactic longitude and latitude, {ra} and {dec}",
        lambda ra, dec, side: "call them l and b",
    ),
)

__all__ = ["apart_doubts"]
