"""The field: a catalogue's stars at the epoch of a frame, with errors, magnitudes and colours."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.records import unpack
from sameas.representation import in_short
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import PositionError
from sameas.sky.column_values import numbers
from sameas.sky.completion import USUAL_ARCSEC
from sameas.space import chord_angle_deg, sphere_offset, unit_vectors


@dataclass(frozen=True)
class Stars:
    """Catalogue stars at the frame's epoch, for plate solving.

    ra_deg, dec_deg : (m,) ICRS. sigma_arcsec : (m,) error per axis, or one number. magnitude : (m,) in any band near
        that of the frame; stars without one (NaN) are sorted last.
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    sigma_arcsec: FloatArray | float
    magnitude: FloatArray
    name: str = "catalogue"

    def __post_init__(self) -> None:
        n = len(self.ra_deg)
        for what in ("dec_deg", "sigma_arcsec", "magnitude"):
            values = np.asarray(getattr(self, what), dtype=np.float64)
            if values.shape != (n,) and not (what == "sigma_arcsec" and values.ndim == 0):
                raise InputError(f"{self.name}: {what} has shape {values.shape}; give one number per star, ({n},)")
        known = np.isfinite(self.ra_deg) & np.isfinite(self.dec_deg) & (np.asarray(self.sigma_arcsec) >= 0)
        if not known.all():
            row = int(np.flatnonzero(~known)[0])
            raise InputError(f"{self.name}: row {row} has no position or no error; leave such stars out")

    def order(self) -> IntArray:
        """(m,) rows, brightest first."""
        return np.argsort(np.where(np.isnan(self.magnitude), np.inf, self.magnitude), kind="stable")


#: Colour columns, and pairs of magnitudes whose difference is a colour, in order of preference.
COLOURS = ("bp_rp", "BP-RP", "b_v", "B-V", "g_r", "J-K")
DIFFERENCES = (
    ("phot_bp_mean_mag", "phot_rp_mean_mag"), ("BPmag", "RPmag"), ("Bmag", "Vmag"), ("BTmag", "VTmag"), ("BT", "VT"),
    ("gmag", "rmag"), ("Jmag", "Kmag"),
)  # fmt: skip


@dataclass(frozen=True)
class Cone:
    """A cone: all directions within a radius of a centre."""

    ra_deg: float
    dec_deg: float
    radius_deg: float

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector."""
        return unit_vectors(self.ra_deg, self.dec_deg)

    def holds(self, other: Cone) -> bool:
        """Whether another cone lies entirely within this one."""
        distance_deg = chord_angle_deg(float(np.linalg.norm(self.direction - other.direction)))
        return distance_deg + other.radius_deg <= self.radius_deg + 1e-9

    def touches(self, other: Cone) -> bool:
        """Whether the cones share a direction."""
        distance_deg = chord_angle_deg(float(np.linalg.norm(self.direction - other.direction)))
        return distance_deg <= self.radius_deg + other.radius_deg


@in_short
@dataclass(frozen=True)
class StarField:
    """Stars of a catalogue at one epoch. Make it with :meth:`StarField.of`.

    Attributes
    ----------
    name : of the catalogue. epoch_jyr : of the positions, None if each is at the star's own epoch.
    rows : (n,) rows of the catalogue's table. ids : (n,) its identifiers.
    ra_deg, dec_deg : (n,) ICRS. covariance_arcsec : (n, 3) east-east, east-north, north-north in arcsec².
    magnitude, colour : (n,), NaN where not known. colour_name : column or difference of columns, empty if none.
    moved_arcsec : (n, 2) displacement east and north from the catalogue's epoch to this one.
    """

    name: str
    epoch_jyr: float | None
    rows: IntArray
    ids: Any
    ra_deg: FloatArray
    dec_deg: FloatArray
    covariance_arcsec: FloatArray
    magnitude: FloatArray
    colour: FloatArray
    colour_name: str
    moved_arcsec: FloatArray

    @classmethod
    def of(
        cls, catalogue: Catalogue, epoch_jyr: float | None, *, motion: bool = True, near: Cone | None = None
    ) -> StarField:
        """The catalogue's usable stars at an epoch.

        epoch_jyr : Julian year of the frame, None if it is not known. motion : False keeps every star at its own epoch,
        for comparison. near : only stars in this cone. Stars of a catalogue without position errors get an initial
        typical one.

        Raises
        ------
        InputError : the catalogue has proper motions, but the epoch of the frame is not known; no row has a position
            and an error.
        """
        known = catalogue.epoch_jyr is not None
        if epoch_jyr is None and known and motion and catalogue.has_motion:
            raise InputError(
                f"{catalogue.name}: its stars move, but the time of the frame is not known",
                naming("give {epoch_jyr:YEAR}, or {pm:'none'} to leave them where they are"),
            )
        rows_used = np.arange(len(catalogue))
        if near is not None:
            rows_used = _near(catalogue, near, epoch_jyr)
            catalogue = _part(catalogue, rows_used)
        if catalogue.error_is_unknown:
            typical = PositionError("number", sigma_arcsec=USUAL_ARCSEC, reason="assumed")
            catalogue = catalogue.with_error(typical)
        records = catalogue.records(epoch_jyr if known and motion and len(catalogue) else None)
        if not len(records) and near is None:
            raise InputError(f"{catalogue.name}: no row has a position and an error of it; check its columns")
        rows, (ra, dec) = records.rows, records.features.T
        full = records.full_covariance()
        a = catalogue.astrometry
        colour, name = _colour(catalogue)
        magnitude = np.full(len(catalogue), np.nan) if catalogue.magnitude is None else catalogue.magnitude
        return cls(
            name=catalogue.name,
            epoch_jyr=epoch_jyr if known and motion else None,
            rows=rows_used[rows],
            ids=np.asarray(catalogue.ids)[rows],
            ra_deg=ra % 360.0,
            dec_deg=dec,
            covariance_arcsec=np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=1),
            magnitude=magnitude[rows],
            colour=colour[rows],
            colour_name=name,
            moved_arcsec=sphere_offset(ra, dec, a.ra_deg[rows], a.dec_deg[rows]),
        )

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, which: Any) -> StarField:
        """Some of the stars, by mask or rows."""
        values = vars(self)
        one = {key: values[key] for key in ("name", "epoch_jyr", "colour_name")}
        many = {key: values[key][which] for key in self.__dataclass_fields__ if key not in one}
        return StarField(**one, **many)

    def with_error(self, sigma_arcsec: float) -> StarField:
        """The same stars with one position error on each axis."""
        variance = np.broadcast_to([sigma_arcsec**2, 0.0, sigma_arcsec**2], (len(self), 3))
        return replace(self, covariance_arcsec=variance.copy())

    @cached_property
    def vectors(self) -> FloatArray:
        """(n, 3) unit vectors."""
        return unit_vectors(self.ra_deg, self.dec_deg)

    def within(self, cone: Cone) -> BoolArray:
        """(n,) mask of the stars in a cone."""
        return np.asarray(self.vectors @ cone.direction >= math.cos(math.radians(min(cone.radius_deg, 180.0))))

    def stars(self) -> Stars:
        """The stars for :func:`sameas.sky.frame.place.place`; the error is the root mean variance of both axes."""
        sigma = np.sqrt(np.trace(unpack(self.covariance_arcsec, 2), axis1=1, axis2=2) / 2.0)
        return Stars(self.ra_deg, self.dec_deg, sigma, self.magnitude, self.name)


def _near(catalogue: Catalogue, cone: Cone, epoch_jyr: float | None) -> IntArray:
    """Rows of the catalogue that are in a cone, or may have moved into it by the epoch."""
    a = catalogue.astrometry
    chord = np.linalg.norm(unit_vectors(a.ra_deg, a.dec_deg) - cone.direction, axis=1)
    distance_deg = np.degrees(2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)))
    years = 0.0 if epoch_jyr is None else np.nan_to_num(epoch_jyr - a.epoch_jyr)
    moved_deg = np.abs(years) * np.hypot(a.pm_ra_mas_per_yr, a.pm_dec_mas_per_yr) / 3.6e6
    with np.errstate(invalid="ignore"):
        return np.flatnonzero(distance_deg <= cone.radius_deg + 1.1 * moved_deg)


def _part(catalogue: Catalogue, rows: IntArray) -> Catalogue:
    """Some rows of a catalogue."""
    magnitude = None if catalogue.magnitude is None else catalogue.magnitude[rows]
    return replace(
        catalogue,
        table=catalogue.table[rows],
        ids=catalogue.ids[rows],
        astrometry=catalogue.astrometry[rows],
        magnitude=magnitude,
        magnitude_error=None,
    )


def _colour(catalogue: Catalogue) -> tuple[FloatArray, str]:
    """(n,) colours of the catalogue's rows and the name of the colour; NaN and empty if there is none."""
    table = catalogue.table
    known = {name.lower(): name for name in table.colnames}
    for name in COLOURS:
        if name.lower() in known:
            column = known[name.lower()]
            return _plausible(numbers(table, column, catalogue.name)), column
    for blue, red in DIFFERENCES:
        if blue.lower() in known and red.lower() in known:
            names = known[blue.lower()], known[red.lower()]
            one, two = (numbers(table, column, catalogue.name) for column in names)
            return _plausible(one - two), " − ".join(names)
    return np.full(len(table), np.nan), ""


def _plausible(colour: FloatArray) -> FloatArray:
    """Colours, NaN for placeholders (20 or more)."""
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(colour) < 20.0, colour, np.nan)
