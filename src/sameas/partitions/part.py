"""One part: the records of a cell and of a halo around it, decided, and whether the halo was wide enough."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas._identify import identify
from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.places import Counts, Learned
from sameas.evidence import Magnitudes
from sameas.groups import laid_out
from sameas.io.arrow import column_of
from sameas.io.parquet import decoded, described
from sameas.partitions import cells as healpix
from sameas.partitions.layout import CELL, Cell, HatsCatalogue
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification
from sameas.sky.bands import ERROR_NAMES, OFF, magnitudes_of
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import PositionError
from sameas.sky.joins import joined
from sameas.space import ARCSEC_PER_RADIAN

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table


@dataclass(frozen=True)
class PartTuning:
    """When the halo of a part is wide enough.

    Attributes
    ----------
    competing : pairs of smaller ln of the odds carry no group on. 0 is where pairs may be chosen; those below move
        probabilities by what they are worth.
    certain_arcsec : the halo is widened no further than to this.
    finer : the halo's edge is followed by cells that are smaller than its own by so many orders.
    """

    competing: float = -4.0
    certain_arcsec: float = 1000.0
    finer: int = 3


DEFAULT_PART = PartTuning()
#: A cell's middle to its farthest corner, over its side.
CORNER = 0.85


@in_short
@dataclass(frozen=True)
class Side:
    """One of the two catalogues, as every part reads it.

    stored : its partitions. understood : its columns, without rows. epoch_jyr : to which it is moved, None: it is not.
    cell_order : of the cells in which records are counted. far : its far records with all columns, None: not yet known.
    far_place : (f, 3) directions where they are at that epoch; far_reach_arcsec : (f,).
    """

    stored: HatsCatalogue
    understood: Catalogue
    epoch_jyr: float | None
    cell_order: int
    far: pa.Table | None = field(repr=False, default=None)
    far_place: FloatArray = field(repr=False, default_factory=lambda: np.empty((0, 3)))
    far_reach_arcsec: FloatArray = field(repr=False, default_factory=lambda: np.empty(0))

    def columns(self, magnitudes: str) -> list[str]:
        """The columns that the identification needs."""
        words = set(_words(self.understood.choice))
        named = {name.strip() for side in magnitudes.split(":") for name in side.split(",")}
        named |= {way.format(name) for name in named for way in ERROR_NAMES}
        known = {name.lower() for name in words | named}
        return [name for name in self.stored.schema.names if name.lower() in known]

    def rows(self, table: pa.Table) -> Rows:
        """Rows understood, and brought to the epoch."""
        cells = np.asarray(table.column(CELL).to_numpy(), np.int64)
        catalogue = self.understood.alike(table_of(table.drop_columns([CELL])))
        return Rows(catalogue, cells, self.records(catalogue), self.cell_order)

    def records(self, catalogue: Catalogue) -> Records:
        """The records of some rows; with errors of 1 arcsec as long as nothing is known of them."""
        if catalogue.error_is_unknown:
            catalogue = catalogue.with_error(PositionError("number", sigma_arcsec=1.0, reason="not known yet"))
        return catalogue.records(self.epoch_jyr)


@in_short
@dataclass(frozen=True)
class Rows:
    """Rows of a catalogue in memory: stored : (n_table,) cells of order 29 by their stored positions."""

    catalogue: Catalogue
    stored: IntArray
    records: Records
    cell_order: int

    @cached_property
    def cells(self) -> IntArray:
        """(n,) cells in which the records are counted."""
        return healpix.cells_of(self.records.features, self.cell_order)

    @cached_property
    def place(self) -> FloatArray:
        """(n, 3) directions of the records."""
        lon, lat = np.radians(self.records.features.T)
        return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])

    @cached_property
    def moved_arcsec(self) -> FloatArray:
        """(n,) distance of the records from their stored positions."""
        at = self.catalogue.astrometry
        lon, lat = np.radians(at.ra_deg[self.records.rows]), np.radians(at.dec_deg[self.records.rows])
        stored = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        return np.asarray(np.linalg.norm(self.place - stored, axis=1) * ARCSEC_PER_RADIAN)

    def moved_limit(self, far_arcsec: float) -> float:
        """How far a record that is not far may have moved, arcsec."""
        usual = self.moved_arcsec[self.moved_arcsec <= far_arcsec]
        return far_arcsec if float(usual.max(initial=0.0)) > 1e-3 else 0.0

    @cached_property
    def sigma_arcsec(self) -> FloatArray:
        """(n,) the larger of both errors, or more."""
        return np.asarray(np.sqrt(self.records.variances.max(axis=1)))


@dataclass(frozen=True)
class Counted:
    """What counting a partition tells: records in cells, rows, and the stored cells of those that reach far."""

    counts: Counts
    rows: int
    far: IntArray


@in_short
@dataclass(frozen=True)
class Work:
    """What is the same for all parts.

    sides : both catalogues. learned : what is known; None as long as it is not. magnitudes, join, nway_columns : as of
    ``sameas.match``. far_arcsec : records that move or whose errors reach farther are looked for everywhere.
    halo_arcsec : with which a part is decided first.
    """

    sides: tuple[Side, Side]
    magnitudes: str
    join: str
    nway_columns: bool
    far_arcsec: float
    halo_arcsec: float = 0.0
    learned: Learned | None = None
    tuning: PartTuning = DEFAULT_PART

    def count(self, side: int, cell: Cell) -> Counted:
        """The records of a partition of catalogue 1 or 2, counted."""
        one = self.sides[side - 1]
        rows = one.rows(one.stored.rows(cell.stretch, one.columns(self.magnitudes)))
        far = (rows.moved_arcsec > self.far_arcsec) | (rows.sigma_arcsec * 10.0 > self.far_arcsec)
        none, cells = np.empty(0, np.int64), rows.cells
        counts = Counts.of(cells, none) if side == 1 else Counts.of(none, cells)
        return Counted(counts, len(rows.catalogue), rows.stored[rows.records.rows[far]])

    def read(self, side: int, stretch: IntArray, near: FloatArray, columns: list[str] | None = None) -> Rows:
        """The rows in stretches, and the far records that reach to within a distance of a direction.

        near : (4,) the direction and the distance, arcsec.
        """
        one = self.sides[side - 1]
        table = one.stored.rows(stretch, columns)
        if one.far is not None and len(one.far):
            import pyarrow as pa

            apart = np.linalg.norm(one.far_place - near[:3], axis=1) * ARCSEC_PER_RADIAN
            cells = np.asarray(one.far.column(CELL).to_numpy(), np.int64)
            wanted = (apart <= near[3] + one.far_reach_arcsec) & ~healpix.within(stretch, cells)
            if wanted.any():
                table = pa.concat_tables(
                    [table, one.far.take(pa.array(np.flatnonzero(wanted))).select(table.column_names)],
                    promote_options="permissive",
                )
        return one.rows(table)

    def decided(self, cell: Cell) -> Part:
        """A cell of the output, decided with a halo that is wide enough."""
        part = self.within(cell, self.halo_arcsec)
        while part.doubtful and part.halo_arcsec < self.tuning.certain_arcsec:
            part = self.within(cell, 2.0 * part.halo_arcsec)
        return part

    def within(self, cell: Cell, halo_arcsec: float) -> Part:
        """A cell decided with a halo at least so wide."""
        halo = Halo.around(cell, halo_arcsec, self.tuning.finer)
        near = halo.reach()
        one, two = (self.read(side, halo.stretch, near) for side in (1, 2))
        result = self.identified(one, two)
        own = tuple(healpix.within(cell.stretch, rows.stored) for rows in (one, two))
        doubtful = self._doubtful(result, one, two, halo)
        of_1 = doubtful & own[0][one.records.rows]
        return Part(cell, halo.width_arcsec, one, two, result, (own[0], own[1]), int(np.count_nonzero(of_1)))

    def identified(self, one: Rows, two: Rows) -> Identification:
        """All records of both, with what is known."""
        assert self.learned is not None
        learned, measured = self.learned, None
        pairs = learned.pairs(one.records, two.records)
        if learned.photometry is not None:
            magnitudes = brightness(one.catalogue, two.catalogue, self.magnitudes)
            measured = None if magnitudes is None else (magnitudes[0].of(one.records), magnitudes[1].of(two.records))
        rule = learned.rule(pairs, (one.cells, two.cells), measured)
        return identify(pairs.first, pairs.second, rule=rule, gate=lambda first, second: pairs)

    def _doubtful(self, result: Identification, one: Rows, two: Rows, halo: Halo) -> BoolArray:
        """(n₁,) whether a record's group comes so near to where the halo ends that others may compete with it."""
        assert self.learned is not None
        tuning, learned = self.tuning, self.learned
        kept = np.flatnonzero(result.evidence.log_ratio > tuning.competing)
        pairs = result.pairs
        if not len(kept):
            return np.zeros(len(one.records), np.bool_)
        sigma = [np.sqrt(records.variances.max(axis=1))
                 for records in learned.start.records(one.records, two.records)]  # fmt: skip
        usual = [float(np.quantile(s, 0.999)) if len(s) else 0.0 for s in sigma]
        moved = max((s.moved_limit(self.far_arcsec) for s in (one, two)), default=0.0)
        edge = []
        for rows, s, other in ((one, sigma[0], usual[1]), (two, sigma[1], usual[0])):
            inside = healpix.within(halo.cell.stretch, rows.stored[rows.records.rows])
            reach = np.minimum(learned.gate_sigmas * np.hypot(s, other), tuning.certain_arcsec)
            near = np.zeros(len(reach), np.bool_)
            # A record of the cell itself that has hardly moved is farther from the edge than the halo is wide.
            asked = np.flatnonzero(~inside | (reach + moved + rows.moved_arcsec > halo.width_arcsec))
            near[asked] = halo.edge_arcsec(rows.place[asked], reach[asked] + moved) <= reach[asked] + moved
            edge.append(near)
        i, j = pairs.i[kept], pairs.j[kept]
        grouped = laid_out(pairs.place_1[kept], pairs.place_2[kept], i, j, len(one.records), len(two.records))
        touched = edge[0][i] | edge[1][j]
        group = grouped.of_pairs()
        bad = np.zeros(len(grouped), np.bool_)
        bad[group[touched]] = True
        doubtful = np.zeros(len(one.records), np.bool_)
        doubtful[i[bad[group]]] = True
        # Without a competing pair a record is alone, whatever may be missing, unless it lies at the edge itself.
        return doubtful


@in_short
@dataclass(frozen=True)
class Halo:
    """A cell and the cells around it. stretch : (k, 2) of all. edges : (e, 3) directions outside, along the edge.

    width_arcsec : everything so near to the cell is in it. side_arcsec : no point outside is farther from one of the
    edges than 0.85 of this.
    """

    cell: Cell
    stretch: IntArray
    edges: FloatArray
    width_arcsec: float
    side_arcsec: float

    @classmethod
    def around(cls, cell: Cell, width_arcsec: float, finer: int) -> Halo:
        """At least so wide; everything where that is wider than a cell of order 0."""
        order = healpix.order_of_width(width_arcsec)
        if width_arcsec > healpix.width_arcsec(0):
            every = np.array([[0, 12 << 2 * healpix.FINEST]], np.int64)
            return cls(cell, every, np.empty((0, 3)), np.inf, 0.0)
        if order >= cell.order:
            inner, base = np.array([cell.number]), cell.order
        else:
            inner, base = np.array([cell.number >> 2 * (cell.order - order)]), order
        ring = healpix.ring(inner, base, order)
        stretch = healpix.joined(np.concatenate([healpix.stretches(inner, base), healpix.stretches(ring, order)]))
        finest = min(order + finer, healpix.FINEST)
        border = healpix.ring(ring, order, finest)
        border = border[~healpix.within(stretch, border << 2 * (healpix.FINEST - finest))]
        side = healpix.SIDE_ARCSEC / 2.0**finest
        return cls(cell, stretch, healpix.centres(border, finest), healpix.width_arcsec(order), side)

    def reach(self) -> FloatArray:
        """(4,) a direction and a distance, arcsec, within which all of it lies."""
        middle = healpix.centres(np.array([self.cell.number]), self.cell.order)[0]
        if not len(self.edges):
            return np.append(middle, 2.0 * ARCSEC_PER_RADIAN)
        far = float(np.linalg.norm(self.edges - middle, axis=1).max()) * ARCSEC_PER_RADIAN
        return np.append(middle, far)

    def edge_arcsec(self, place: FloatArray, up_to: FloatArray) -> FloatArray:
        """(n,) distances of directions from where it ends, or less; infinite where that is more than asked for."""
        from scipy.spatial import cKDTree

        if not len(place) or not len(self.edges):
            return np.full(len(place), np.inf)
        slack = CORNER * self.side_arcsec
        most = (float(up_to.max()) + slack) / ARCSEC_PER_RADIAN
        distance, _ = cKDTree(self.edges).query(place, distance_upper_bound=most)
        return np.asarray(distance * ARCSEC_PER_RADIAN - slack)


@in_short
@dataclass(frozen=True)
class Part:
    """A cell decided. own : (n_table,) of either whether a row is stored in the cell. doubtful : records of the first
    catalogue for whose answer the halo may be too narrow."""

    cell: Cell
    halo_arcsec: float
    one: Rows
    two: Rows
    result: Identification
    own: tuple[BoolArray, BoolArray]
    doubtful: int

    @property
    def first(self) -> Catalogue:
        """The first catalogue's rows."""
        return self.one.catalogue

    @property
    def second(self) -> Catalogue:
        """The second catalogue's rows."""
        return self.two.catalogue

    def table(self, work: Work) -> tuple[Table, IntArray]:
        """The joined rows of the cell by their cells of order 29, and these."""
        assert work.learned is not None
        seen = [
            rows.records.over_table(work.learned.seen(rows.cells, k + 1)) for k, rows in enumerate((self.one, self.two))
        ]
        joinable = _Joinable(self.first, self.second, self.result, seen[0], seen[1])
        for k, rows in enumerate((self.one, self.two), 1):
            place = rows.catalogue.astrometry
            for name, values in zip(_PLACE, (rows.stored, place.ra_deg, place.dec_deg), strict=True):
                rows.catalogue.table[f"{_CARRIED}{name}_{k}"] = values
        table = joined(joinable, work.join, nway_columns=work.nway_columns, own=self.own)
        cell, ra, dec = (_of_either(table, name) for name in _PLACE)
        table.remove_columns([name for name in table.colnames if name.startswith(_CARRIED)])
        for rows in (self.one, self.two):
            names = [name for name in rows.catalogue.table.colnames if name.startswith(_CARRIED)]
            rows.catalogue.table.remove_columns(names)
        if work.join in WITH_SECOND:
            table["_ra"], table["_dec"] = ra, dec
        # A group's number and size depend on how far the halo reaches, and rows that are numbered on the part.
        numbered = any(c.choice.id is None for c in (self.first, self.second))
        table.remove_columns([name for name in ("group_id", "group_size", *["id_second"] * numbered)
                              if name in table.colnames])  # fmt: skip
        order = np.argsort(cell, kind="stable")
        return table[order], cell[order]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What is added up over the parts."""
        own = self.own[0][self.result.matches.rows_1]
        own_pairs = self.own[0][self.result.rows_1]
        p, chosen = self.result.p_pair[own_pairs], self.result.chosen[own_pairs]
        return {
            "rows_1": int(np.count_nonzero(self.own[0])),
            "rows_2": int(np.count_nonzero(self.own[1])),
            "candidates": len(p),
            "pairs": int(np.count_nonzero(own)),
            "expected_common": float(p.sum()),
            "expected_wrong": float((1.0 - p[chosen]).sum()),
            "doubtful": self.doubtful,
            "halo_arcsec": self.halo_arcsec,
        }


@dataclass(frozen=True)
class _Joinable:
    first: Catalogue
    second: Catalogue
    result: Identification
    covered_1: BoolArray
    covered_2: BoolArray


#: Columns that carry the rows' stored places through a join begin so.
_CARRIED, _PLACE = "_sameas_carried_", ("cell", "ra", "dec")
#: Joins that write rows of the second catalogue that have no partner.
WITH_SECOND = ("all2", "1or2", "2not1", "1xor2")


def _of_either(table: Table, name: str) -> NDArray[Any]:
    """What is carried of the first catalogue's row, or, without one, of the second's."""
    one, two = (np.ma.masked_array(table[f"{_CARRIED}{name}_{k}"]) for k in (1, 2))
    return np.where(np.ma.getmaskarray(one), np.ma.getdata(two), np.ma.getdata(one))


def brightness(first: Catalogue, second: Catalogue, magnitudes: str) -> tuple[Magnitudes, Magnitudes] | None:
    """The magnitudes that are evidence, as ``sameas.match`` takes them."""
    return None if magnitudes == OFF else magnitudes_of(first, second, magnitudes)


def without_rows(catalogue: Catalogue) -> Catalogue:
    """What was understood of a catalogue, alone."""
    none = catalogue.table[:0]
    return replace(catalogue, table=none, ids=catalogue.ids[:0], magnitude=None, magnitude_error=None,
                   astrometry=None, doubts=())  # type: ignore[arg-type] # fmt: skip


def table_of(table: pa.Table) -> Table:
    """The astropy table of an Arrow table; columns that no cell can hold are left out."""
    from astropy.table import Table

    columns = []
    for at, name in enumerate(table.column_names):
        column = column_of(name, table.column(at))
        if column is not None:
            described(column, decoded(table.schema.field(at).metadata))
            columns.append(column)
    return Table(columns, copy=False)


def _words(value: Any) -> list[str]:
    """All texts in a value."""
    if isinstance(value, str):
        return [value]
    if hasattr(value, "__dataclass_fields__"):
        return [word for name in value.__dataclass_fields__ for word in _words(getattr(value, name))]
    if isinstance(value, list | tuple):
        return [word for one in value for word in _words(one)]
    return []
