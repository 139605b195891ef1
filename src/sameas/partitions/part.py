"""One part of two partitioned catalogues: cells and a halo around them are identified, and the halo's width is tested.

A part's own records are decided as in the whole catalogues if no group that contains one of them reaches the halo's
edge (docs/partitions.md, "Why the answer is the same").
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas._identify import identify
from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.assignment import Hypothesis, assign
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.places import CellCounts, Learned
from sameas.evidence import Column, Magnitudes, Related, Rule
from sameas.gate import Pairs
from sameas.groups import Groups, groups, laid_out
from sameas.io.arrow import column_of
from sameas.io.parquet import decoded, described
from sameas.partitions import healpix
from sameas.partitions.hats import CELL, Cell, HatsCatalogue, numbers_of
from sameas.posterior import APPROXIMATE, Posterior, posterior
from sameas.prior import EVIDENCE_ALONE
from sameas.records import Records
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import PositionError
from sameas.sky.evidence_columns import MAGNITUDE_ERROR_NAMES, OFF, columns_of, magnitudes_of
from sameas.sky.joins import joined, joined_rows
from sameas.space import ARCSEC_PER_RADIAN, mean_direction, unit_vectors

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table


#: Only pairs of larger log odds extend a group, since others are never chosen. The effect of the others on
#: probabilities falls off within one or two gates: halos of 32″ and of 129″ gave the same to 1e-11 at λ 2.
COMPETING = 0.0
CERTAIN_ARCSEC = 1000.0  # the widest halo
#: Probabilities of records are summed over their groups and the groups of their candidates, of the candidates'
#: candidates, and so on, this many times; twice as many where the method of summing may depend on records farther out.
#: With 2, 3 and 6 steps they differ from those of a whole field by 6e-8, 7e-10 and 7e-10 at λ 2.
STEPS = 3
#: Approximate candidates of the records whose probabilities are summed at once; 250 bytes for each of them and of those
#: around them.
AT_ONCE = 450_000
MAX_SHARE = 0.8  # if a sum needs more than this share of all records, it takes all of them
FINER = 3  # orders by which the cells along the halo's edge are finer than cells of the halo's width


COUNTED_AT_ONCE = 200_000  # rows of a partition that are counted at once; about 200 bytes each
#: Masks (n₁,) and (n₂,) of the records of both catalogues.
Both = tuple[BoolArray, BoolArray]
#: Largest distance of a cell's centre from its corners, in units of its side.
CORNER = 0.85
#: A halo consists of rings of cells this many orders finer than cells of its width: it is little wider than needed.
RING_ORDERS = 3


@dataclass(frozen=True)
class Side:
    """One of the two catalogues, as every part reads it.

    stored : its partitions. catalogue : without rows, its columns recognised. epoch_jyr : to which it is moved, None
    for not. cell_order : of the cells in which records are counted. far : its far records with all columns, None until
    they are known. far_direction : (f, 3) their directions at that epoch. far_reach_arcsec : (f,) 10σ of their errors.
    """

    stored: HatsCatalogue
    catalogue: Catalogue
    epoch_jyr: float | None
    cell_order: int
    far: pa.Table | None = field(repr=False, default=None)
    far_direction: FloatArray = field(repr=False, default_factory=lambda: np.empty((0, 3)))
    far_reach_arcsec: FloatArray = field(repr=False, default_factory=lambda: np.empty(0))

    def columns(self, magnitudes: str, evidence: Sequence[Column | Related] = ()) -> list[str]:
        """The columns that the identification needs."""
        names = set(_strings_in(self.catalogue.choice))
        for one in evidence:
            names |= {c.values for c in (one.columns if isinstance(one, Related) else (one,))}
        bands = {name.strip() for side in magnitudes.split(":") for name in side.split(",")}
        bands |= {pattern.format(name) for name in bands for pattern in MAGNITUDE_ERROR_NAMES}
        needed = {name.lower() for name in names | bands}
        return [name for name in self.stored.schema.names if name.lower() in needed]

    def rows(self, table: pa.Table) -> Rows:
        """The rows of a table with their records, moved to the epoch."""
        cells = numbers_of(table, CELL)
        catalogue = self.catalogue.with_rows(table_of(table.drop_columns([CELL])))
        choice = self.catalogue.choice
        by_position = (choice.ra.name, choice.dec.name) == self.stored.position and choice.frame == "icrs"
        return Rows(catalogue, cells, self.records(catalogue), self.cell_order, by_position)

    def records(self, catalogue: Catalogue) -> Records:
        """The records of some rows, with errors of 1 arcsec while the catalogue's are unknown."""
        if catalogue.error_is_unknown:
            catalogue = catalogue.with_error(PositionError("number", sigma_arcsec=1.0, reason="not known yet"))
        return catalogue.records(self.epoch_jyr)


@dataclass(frozen=True)
class Rows:
    """Rows of a catalogue in memory.

    stored : (n_table,) cells of order 29 of the positions by which the catalogue is partitioned; cut_by_position :
    whether these are the positions from which the records are made.
    """

    catalogue: Catalogue
    stored: IntArray
    records: Records
    cell_order: int
    cut_by_position: bool

    @cached_property
    def unmoved(self) -> bool:
        """Whether all records have the catalogue's positions, without motion."""
        ra_deg, dec_deg = self.catalogue.astrometry.ra_deg, self.catalogue.astrometry.dec_deg
        rows, features = self.records.rows, self.records.features
        if len(rows) < len(ra_deg):
            ra_deg, dec_deg = ra_deg[rows], dec_deg[rows]
        return np.array_equal(features[:, 0], ra_deg) and np.array_equal(features[:, 1], dec_deg)

    @cached_property
    def cells(self) -> IntArray:
        """(n,) cells in which the records are counted."""
        if self.unmoved and self.cut_by_position:
            return self.stored[self.records.rows] >> 2 * (healpix.FINEST - self.cell_order)
        return healpix.cells_of(self.records.features, self.cell_order)

    @cached_property
    def direction(self) -> FloatArray:
        """(n, 3) directions of the records."""
        return unit_vectors(*self.records.features.T)

    @cached_property
    def moved_arcsec(self) -> FloatArray:
        """(n,) distance of the records from their stored positions."""
        if self.unmoved:
            return np.zeros(len(self.records))
        astrometry = self.catalogue.astrometry
        stored = unit_vectors(astrometry.ra_deg[self.records.rows], astrometry.dec_deg[self.records.rows])
        return np.asarray(np.linalg.norm(self.direction - stored, axis=1) * ARCSEC_PER_RADIAN)

    def moved_limit(self, far_arcsec: float) -> float:
        """Upper limit of the motion of records that are not far, arcsec: 0 if none of them moved."""
        moved = self.moved_arcsec[self.moved_arcsec <= far_arcsec]
        return far_arcsec if float(moved.max(initial=0.0)) > 1e-3 else 0.0

    @cached_property
    def sigma_arcsec(self) -> FloatArray:
        """(n,) σ of the less certain component of each position."""
        return np.asarray(np.sqrt(self.records.variances.max(axis=1)))


@dataclass(frozen=True)
class Counted:
    """The counts of a partition: records by cell, number of rows, and the stored cells (f,) of its far records."""

    counts: CellCounts
    rows: int
    far: IntArray


@dataclass(frozen=True)
class Work:
    """The settings of all parts.

    sides : both catalogues. learned : the estimates, None before. magnitudes, evidence, join, nway_columns : as in
    ``sameas.match``. far_arcsec : records whose motion or 10σ error is larger are far, and read for every part that
    they may reach. halo_arcsec : the first halo of a part. margin_arcsec : a halo wide enough for nearly all parts.
    """

    sides: tuple[Side, Side]
    magnitudes: str
    evidence: tuple[Column | Related, ...]
    join: str
    nway_columns: bool
    far_arcsec: float
    halo_arcsec: float = 0.0
    margin_arcsec: float = 0.0
    learned: Learned | None = None

    def columns(self, side: int) -> list[str]:
        """The columns of catalogue 1 or 2 that the identification needs."""
        return self.sides[side - 1].columns(self.magnitudes, self.evidence)

    def count(self, side: int, cell: Cell, rows_at_once: int = COUNTED_AT_ONCE) -> Counted:
        """The counts of a partition of catalogue 1 or 2."""
        one, none = self.sides[side - 1], np.empty(0, np.int64)
        counts, number, far_cells = [CellCounts.of(none, none)], 0, [none]
        for table in one.stored.pieces(cell, self.columns(side), rows_at_once):
            rows = one.rows(table)
            far = (rows.moved_arcsec > self.far_arcsec) | (rows.sigma_arcsec * 10.0 > self.far_arcsec)
            counts.append(CellCounts.of(rows.cells, none) if side == 1 else CellCounts.of(none, rows.cells))
            number += len(rows.catalogue)
            far_cells.append(rows.stored[rows.records.rows[far]])
        return Counted(CellCounts.sum(counts), number, np.sort(np.concatenate(far_cells)))

    def read(self, side: int, stretch: IntArray, near: FloatArray, columns: list[str] | None = None) -> Rows:
        """The rows in stretches of cells, and the far records whose errors reach a disc.

        near : (4,) the disc's direction and radius in arcsec.
        """
        one = self.sides[side - 1]
        table = one.stored.rows(stretch, columns)
        if one.far is not None and len(one.far):
            import pyarrow as pa

            distance = np.linalg.norm(one.far_direction - near[:3], axis=1) * ARCSEC_PER_RADIAN
            cells = numbers_of(one.far, CELL)
            added = (distance <= near[3] + one.far_reach_arcsec) & ~healpix.within(stretch, cells)
            if added.any():
                table = pa.concat_tables(
                    [table, one.far.take(pa.array(np.flatnonzero(added))).select(table.column_names)],
                    promote_options="permissive",
                )
        return one.rows(table)

    def decide(self, cells: Sequence[Cell]) -> list[DecidedPart]:
        """The parts of a piece, some cells of one order.

        The first part is the piece without the small cells of doubtful records; the next part has these cells and a
        halo twice as wide, again without those of its doubtful records, and so on.
        """
        patch = Patch(cells[0].order, np.array([cell.number for cell in cells]))
        parts = [self.decide_patch(patch, self.halo_arcsec)]
        order = max(patch.order, self.sides[0].cell_order)
        while parts[-1].n_doubtful and parts[-1].halo_arcsec < CERTAIN_ARCSEC:
            previous = parts.pop()
            doubtful_patch = Patch(order, previous.doubtful_cells(order))
            parts += [previous.without(doubtful_patch), self.decide_patch(doubtful_patch, 2.0 * previous.halo_arcsec)]
        return parts

    def decide_patch(self, patch: Patch, halo_arcsec: float) -> DecidedPart:
        """The cells of a patch decided with a halo of at least this width."""
        halo = Halo.around(patch, halo_arcsec, FINER)
        disc = halo.disc()
        one, two = (self.read(side, halo.stretch, disc) for side in (1, 2))
        pairs, rule = self._evidence(one, two)
        evidence = rule(pairs)
        log_ratio = evidence.log_ratio
        stored = (healpix.within(patch.stretch, one.stored), healpix.within(patch.stretch, two.stored))
        own = stored[0][one.records.rows], stored[1][two.records.rows]
        competing = Competing.of(pairs, log_ratio, COMPETING)
        edge = self._edge(one, two, halo)
        grouped = groups(pairs)
        best = assign(grouped, log_ratio, EVIDENCE_ALONE(grouped.sizes_1, grouped.sizes_2))
        p_pair = np.zeros(len(pairs))
        unsummed = np.zeros_like(own[0]), np.zeros_like(own[1])
        for block in self._blocks(pairs, own, one, two):
            of_block = self._sum(p_pair, pairs, log_ratio, (grouped, best), competing, block, edge)
            unsummed = unsummed[0] | of_block[0], unsummed[1] | of_block[1]
        summed = Posterior(p_pair, np.full(len(grouped), APPROXIMATE, np.int8), np.zeros(len(grouped)), 0.0)
        result = Identification(pairs, grouped, evidence, best, summed)
        touching = competing.in_groups(competing.groups_of(*edge))
        doubtful = own[0] & (touching[0] | unsummed[0]), own[1] & (touching[1] | unsummed[1])
        return DecidedPart(halo.width_arcsec, one, two, result, stored, doubtful)

    def identified(self, one: Rows, two: Rows) -> Identification:
        """All records of both identified by the estimates, without parts."""
        pairs, rule = self._evidence(one, two)
        return identify(pairs.first, pairs.second, rule=rule, gate=lambda first, second: pairs)

    def _evidence(self, one: Rows, two: Rows) -> tuple[Pairs, Rule]:
        """The candidates and the rule that gives their evidence."""
        assert self.learned is not None
        learned, measured, columns = self.learned, None, None
        pairs = _by_cells(learned.pairs(one.records, two.records), one, two)
        if learned.photometry is not None:
            magnitudes = brightness(one.catalogue, two.catalogue, self.magnitudes)
            measured = None if magnitudes is None else (magnitudes[0].of(one.records), magnitudes[1].of(two.records))
        if learned.columns is not None:
            given = columns_of(one.catalogue, two.catalogue, self.evidence, self.magnitudes)
            columns = ColumnEvidence.of(one.records, two.records, given)
        return pairs, learned.rule(pairs, (one.cells, two.cells), measured, columns)

    def _blocks(self, pairs: Pairs, own: Both, one: Rows, two: Rows) -> Iterator[Both]:
        """The part's own records in stretches of the sky with about ``at_once`` candidates each."""
        stored = [rows.stored[rows.records.rows] for rows in (one, two)]
        number = math.ceil(np.count_nonzero(own[0][pairs.i]) / AT_ONCE)
        if number <= 1:
            yield own
            return
        ends = np.quantile(stored[0][own[0]], np.arange(1, number) / number, method="nearest")
        block = [np.searchsorted(ends, cells, side="right") for cells in stored]
        for k in range(number):
            yield own[0] & (block[0] == k), own[1] & (block[1] == k)

    def _sum(
        self, p_pair: FloatArray, pairs: Pairs, log_ratio: FloatArray, whole: tuple[Groups, Hypothesis],
        competing: Competing, wanted: Both, edge: Both,
    ) -> Both:  # fmt: skip
        """Write ``p_pair`` (m,) of the pairs of wanted records; returns those whose sums need records outside the halo.

        whole : groups and best hypothesis of all pairs. edge : records at the halo's edge. Records a few gates away
        change a probability by less than rounding, except that whether a component is summed exactly depends on all of
        it: where a component continues outside the records taken, more are taken around it.
        """
        steps, n_records = STEPS, len(wanted[0]) + len(wanted[1])
        while True:
            near = competing.extended(wanted, steps)
            if sum(map(np.count_nonzero, near)) > MAX_SHARE * n_records:
                near = np.ones_like(near[0]), np.ones_like(near[1])
            of_1, of_2 = near[0][pairs.i], near[1][pairs.j]
            kept, severed = np.flatnonzero(of_1 & of_2), np.flatnonzero(of_1 != of_2)
            cut = edge[0].copy(), edge[1].copy()
            cut[0][pairs.i[severed]] = cut[1][pairs.j[severed]] = True
            i, j = pairs.i[kept], pairs.j[kept]
            grouped, best = whole
            if len(kept) < len(pairs):
                grouped = laid_out(pairs.place_1[kept], pairs.place_2[kept], i, j, len(cut[0]), len(cut[1]))
                best = assign(grouped, log_ratio[kept], EVIDENCE_ALONE(grouped.sizes_1, grouped.sizes_2))
            summed = posterior(grouped, best, cut=cut)
            written = wanted[0][i] | wanted[1][j]
            p_pair[kept[written]] = summed.p_pair[written]
            assert summed.open is not None
            unsummed = np.zeros_like(near[0]), np.zeros_like(near[1])
            unsummed[0][i[summed.open]] = unsummed[1][j[summed.open]] = True
            wanted = wanted[0] & unsummed[0], wanted[1] & unsummed[1]
            if not len(severed) or not (wanted[0].any() or wanted[1].any()):
                return wanted
            steps *= 2

    def _edge(self, one: Rows, two: Rows, halo: Halo) -> Both:
        """Whether records outside the halo may be candidates of a record."""
        assert self.learned is not None
        learned = self.learned
        sigmas = [np.sqrt(records.variances.max(axis=1)) for records in learned.start.records(one.records, two.records)]
        max_sigma = [float(np.quantile(sigma, 0.999)) if len(sigma) else 0.0 for sigma in sigmas]
        moved = max((rows.moved_limit(self.far_arcsec) for rows in (one, two)), default=0.0)

        def at_edge(rows: Rows, sigma_arcsec: FloatArray, other: float) -> BoolArray:
            inside = healpix.within(halo.own, rows.stored[rows.records.rows])
            reach = np.minimum(learned.gate_sigmas * np.hypot(sigma_arcsec, other), CERTAIN_ARCSEC)
            near = np.zeros(len(reach), np.bool_)
            # A record of the patch that has hardly moved is farther from the edge than the halo's width.
            tested = np.flatnonzero(~inside | (reach + moved + rows.moved_arcsec > halo.width_arcsec))
            near[tested] = halo.edge_arcsec(rows.direction[tested], reach[tested] + moved) <= reach[tested] + moved
            return near

        return at_edge(one, sigmas[0], max_sigma[1]), at_edge(two, sigmas[1], max_sigma[0])


@dataclass(frozen=True)
class Competing:
    """Candidates, and the groups of the competing pairs, those that can be chosen.

    i, j : (m,) records of the candidates. group_1, group_2 : (n₁,), (n₂,) numbers of the records' groups, ABSENT
    without a competing pair. groups : number of groups.
    """

    i: NDArray[np.int32]
    j: NDArray[np.int32]
    group_1: NDArray[np.int32]
    group_2: NDArray[np.int32]
    groups: int

    @classmethod
    def of(cls, pairs: Pairs, log_ratio: FloatArray, least: float) -> Competing:
        """From pairs, which compete if their log odds are above ``least``."""
        kept = np.flatnonzero(log_ratio > least)
        n_1, n_2 = len(pairs.first), len(pairs.second)
        i, j = pairs.i[kept], pairs.j[kept]
        grouped = laid_out(pairs.place_1[kept], pairs.place_2[kept], i, j, n_1, n_2)
        of_pairs = grouped.of_pairs()
        group_1, group_2 = np.full(n_1, ABSENT, np.int32), np.full(n_2, ABSENT, np.int32)
        group_1[i], group_2[j] = of_pairs, of_pairs
        return cls(pairs.i, pairs.j, group_1, group_2, len(grouped))

    def groups_of(self, records_1: BoolArray, records_2: BoolArray) -> BoolArray:
        """(g + 1,) the groups that contain one of these records; the last element, for no group, is False."""
        contains = np.zeros(self.groups + 1, np.bool_)
        contains[self.group_1[records_1]] = True
        contains[self.group_2[records_2]] = True
        contains[-1] = False
        return contains

    def in_groups(self, groups: BoolArray) -> Both:
        """(n₁,), (n₂,) the records in these groups."""
        return groups[self.group_1], groups[self.group_2]

    def extended(self, own: Both, steps: int) -> Both:
        """(n₁,), (n₂,) some records and their groups, extended ``steps`` times by all candidates and their groups."""
        one, two = (some | more for some, more in zip(own, self.in_groups(self.groups_of(*own)), strict=True))
        for _ in range(steps):
            more_1, more_2 = one.copy(), two.copy()
            more_1[self.i[two[self.j]]] = True
            more_2[self.j[one[self.i]]] = True
            with_1, with_2 = self.in_groups(self.groups_of(more_1, more_2))
            one, two = more_1 | with_1, more_2 | with_2
        return one, two


@dataclass(frozen=True)
class Patch:
    """Cells of one order, (c,), that are decided together."""

    order: int
    cells: IntArray

    @cached_property
    def stretch(self) -> IntArray:
        """(k, 2) their stretches."""
        return healpix.stretches(self.cells, self.order)

    def coarser(self, order: int) -> Patch:
        """The cells of a coarser order that contain the patch; itself if the order is not coarser."""
        if order >= self.order:
            return self
        return Patch(order, np.unique(self.cells >> 2 * (self.order - order)))


@dataclass(frozen=True)
class Halo:
    """A patch and the cells around it.

    own : (o, 2) stretches of the patch. stretch : (k, 2) of patch and halo. middle : (3,) a direction in the patch.
    edges : (e, 3) centres of cells just outside, all along the edge. width_arcsec : the halo contains every point this
    near to the patch. side_arcsec : of the cells along the edge: no point of them is farther than CORNER times this
    from their centre.
    """

    own: IntArray
    stretch: IntArray
    middle: FloatArray
    edges: FloatArray
    width_arcsec: float
    side_arcsec: float

    @classmethod
    def around(cls, patch: Patch, width_arcsec: float, finer: int) -> Halo:
        """The halo of at least this width; the whole sky if that is wider than a cell of order 0."""
        order = healpix.order_of_width(width_arcsec)
        middle = mean_direction(healpix.centres(patch.cells, patch.order))
        if width_arcsec > healpix.width_arcsec(0):
            whole_sky = np.array([[0, 12 << 2 * healpix.FINEST]], np.int64)
            return cls(patch.stretch, whole_sky, middle, np.empty((0, 3)), np.inf, 0.0)
        coarse, thin = patch.coarser(order), order + RING_ORDERS
        rings = math.ceil(width_arcsec / healpix.width_arcsec(thin))
        stretch, ring = coarse.stretch, healpix.ring(coarse.cells, coarse.order, thin)
        for _ in range(rings - 1):
            stretch = healpix.joined(np.concatenate([stretch, healpix.stretches(ring, thin)]))
            ring = healpix.ring(ring, thin, thin)
            ring = ring[~healpix.within(stretch, ring << 2 * (healpix.FINEST - thin))]
        stretch = healpix.joined(np.concatenate([stretch, healpix.stretches(ring, thin)]))
        finest = min(order + finer, healpix.FINEST)
        border = healpix.ring(ring, thin, finest)
        border = border[~healpix.within(stretch, border << 2 * (healpix.FINEST - finest))]
        side = healpix.SIDE_ARCSEC / 2.0**finest
        centres = healpix.centres(border, finest)
        return cls(patch.stretch, stretch, middle, centres, rings * healpix.width_arcsec(thin), side)

    def disc(self) -> FloatArray:
        """(4,) direction and radius, arcsec, of a disc that contains the halo."""
        if not len(self.edges):
            return np.append(self.middle, 2.0 * ARCSEC_PER_RADIAN)
        far = float(np.linalg.norm(self.edges - self.middle, axis=1).max()) * ARCSEC_PER_RADIAN
        return np.append(self.middle, far)

    def edge_arcsec(self, direction: FloatArray, max_arcsec: FloatArray) -> FloatArray:
        """(n,) lower bounds of the distances of directions from the edge; infinite above the largest ``max_arcsec``."""
        from scipy.spatial import cKDTree

        if not len(direction) or not len(self.edges):
            return np.full(len(direction), np.inf)
        slack = CORNER * self.side_arcsec
        limit = (float(max_arcsec.max()) + slack) / ARCSEC_PER_RADIAN
        distance, _ = cKDTree(self.edges).query(direction, distance_upper_bound=limit)
        return np.asarray(distance * ARCSEC_PER_RADIAN - slack)


@dataclass(frozen=True)
class DecidedPart:
    """A decided part.

    own : (n_table,) for either catalogue, the rows stored in the part's cells. doubtful_records : (n,) for either, the
    records of these rows whose answer a wider halo might change.
    """

    halo_arcsec: float
    one: Rows
    two: Rows
    result: Identification
    own: tuple[BoolArray, BoolArray]
    doubtful_records: tuple[BoolArray, BoolArray]

    @property
    def n_doubtful(self) -> int:
        """Number of records whose answer a wider halo might change."""
        return sum(int(np.count_nonzero(mask)) for mask in self.doubtful_records)

    def doubtful_cells(self, order: int) -> IntArray:
        """The cells of this order that contain doubtful records."""
        shift = 2 * (healpix.FINEST - order)
        cells = [rows.stored[rows.records.rows[mask]] >> shift
                for rows, mask in zip((self.one, self.two), self.doubtful_records, strict=True)]  # fmt: skip
        return np.unique(np.concatenate(cells))

    def without(self, patch: Patch) -> DecidedPart:
        """The part without the cells of a patch, and with no record doubtful: the patch has them all."""
        own_1, own_2 = (own & ~healpix.within(patch.stretch, rows.stored)
                        for own, rows in zip(self.own, (self.one, self.two), strict=True))  # fmt: skip
        none_1, none_2 = (np.zeros(len(mask), np.bool_) for mask in self.doubtful_records)
        return replace(self, own=(own_1, own_2), doubtful_records=(none_1, none_2))

    @property
    def first(self) -> Catalogue:
        """The first catalogue's rows."""
        return self.one.catalogue

    @property
    def second(self) -> Catalogue:
        """The second catalogue's rows."""
        return self.two.catalogue

    def table(self, work: Work) -> tuple[Table, IntArray]:
        """The joined rows by ascending cell of order 29, and these cells."""
        assert work.learned is not None
        covered = [
            rows.records.over_table(work.learned.seen(rows.cells, k + 1)) for k, rows in enumerate((self.one, self.two))
        ]
        joinable = _Joinable(self.first, self.second, self.result, covered[0], covered[1])
        rows = joined_rows(joinable, work.join).of(*self.own)
        cell = rows.either(self.one.stored, self.two.stored)
        if np.any(cell[1:] < cell[:-1]):
            order = np.argsort(cell, kind="stable")
            rows, cell = rows.take(order), cell[order]
        table = joined(joinable, work.join, nway_columns=work.nway_columns, rows=rows)
        if work.join in WITH_SECOND:
            one, two = self.first.astrometry, self.second.astrometry
            table["_ra"], table["_dec"] = rows.either(one.ra_deg, two.ra_deg), rows.either(one.dec_deg, two.dec_deg)
        # A group's number and size depend on the halo, and row numbers used as ids on the part.
        numbered = any(c.choice.id is None for c in (self.first, self.second))
        table.remove_columns([name for name in ("group_id", "group_size", *["id_second"] * numbered)
                              if name in table.colnames])  # fmt: skip
        return table, cell

    @cached_property
    def sums(self) -> PartSums:
        """Its own numbers, to be added to those of other parts."""
        own = self.own[0][self.result.matches.rows_1]
        own_pairs = self.own[0][self.result.rows_1]
        p, chosen = self.result.p_pair[own_pairs], self.result.chosen[own_pairs]
        return PartSums(
            read=len(self.one.records) + len(self.two.records),
            pairs=int(np.count_nonzero(own)),
            expected_common=float(p.sum()),
            expected_wrong=float((1.0 - p[chosen]).sum()),
            doubtful=self.n_doubtful,
            halo_arcsec=self.halo_arcsec,
        )


@dataclass(frozen=True)
class PartSums:
    """Numbers of one decided part or more.

    read : records in the parts and their halos, counted again for each widened halo. pairs : identified.
    expected_common, expected_wrong : expected numbers of common objects, and of wrong pairs. doubtful : rows whose
    answer a wider halo might change. halo_arcsec : the widest.
    """

    read: int
    pairs: int
    expected_common: float
    expected_wrong: float
    doubtful: int
    halo_arcsec: float

    @classmethod
    def of(cls, parts: Sequence[PartSums]) -> PartSums:
        """The sums of several."""
        return cls(
            read=sum(one.read for one in parts),
            pairs=sum(one.pairs for one in parts),
            expected_common=sum(one.expected_common for one in parts),
            expected_wrong=sum(one.expected_wrong for one in parts),
            doubtful=sum(one.doubtful for one in parts),
            halo_arcsec=max(one.halo_arcsec for one in parts),
        )


@dataclass(frozen=True)
class _Joinable:
    first: Catalogue
    second: Catalogue
    result: Identification
    covered_1: BoolArray
    covered_2: BoolArray


#: Joins that write rows of the second catalogue that have no partner.
WITH_SECOND = ("all2", "1or2", "2not1", "1xor2")


def _by_cells(pairs: Pairs, one: Rows, two: Rows) -> Pairs:
    """The candidates ordered by the stored cells of their records: the order of a group's sum, and where sums are
    approximated, then do not depend on the other records of the part."""
    rank_1, rank_2 = (_ranks(rows)[k] for rows, k in ((one, pairs.i), (two, pairs.j)))
    order = np.argsort(rank_1.astype(np.int64) << 32 | rank_2, kind="stable")  # merges ascending runs
    return replace(pairs.part(order), place_1=rank_1[order], place_2=rank_2[order])


def _ranks(rows: Rows) -> NDArray[np.int32]:
    """(n,) ranks of the records by their stored cells."""
    rank = np.empty(len(rows.records), np.int32)
    rank[np.argsort(rows.stored[rows.records.rows], kind="stable")] = np.arange(len(rank), dtype=np.int32)
    return rank


def brightness(first: Catalogue, second: Catalogue, magnitudes: str) -> tuple[Magnitudes, Magnitudes] | None:
    """The magnitudes used as evidence, as by ``sameas.match``; None for no such evidence."""
    return None if magnitudes == OFF else magnitudes_of(first, second, magnitudes)


def without_rows(catalogue: Catalogue) -> Catalogue:
    """The catalogue's recognised columns, without its rows."""
    none = catalogue.table[:0]
    return replace(catalogue, table=none, ids=catalogue.ids[:0], magnitude=None, magnitude_error=None,
                   astrometry=None, doubts=())  # type: ignore[arg-type] # fmt: skip


def table_of(table: pa.Table) -> Table:
    """The astropy table of an Arrow table, without structures and maps, which no astropy column can hold."""
    from astropy.table import Table

    columns = []
    for at, name in enumerate(table.column_names):
        column = column_of(name, table.column(at))
        if column is not None:
            described(column, decoded(table.schema.field(at).metadata))
            columns.append(column)
    return Table(columns, copy=False)


def _strings_in(value: object) -> list[str]:
    """All strings in a value, in the fields of its dataclasses and the items of its lists."""
    if isinstance(value, str):
        return [value]
    if hasattr(value, "__dataclass_fields__"):
        return [text for name in value.__dataclass_fields__ for text in _strings_in(getattr(value, name))]
    if isinstance(value, list | tuple):
        return [text for one in value for text in _strings_in(one)]
    return []
