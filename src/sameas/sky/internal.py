"""Internal match: which rows of one table are the same object, such as detections on many exposures.

Objects are a Poisson field of local density ρ. An object has K rows with the probability f(K), each displaced from its
place by its own error. A partition of the rows into objects C is as probable as the product of

    w(C) = ρ f(K) K! ∫ Π_{i∈C} N(x_i; μ, S_i) dμ,

with K! replaced by 1 / (T over K) where the T exposures are known; each row beyond the first of one exposure costs a
factor more (:data:`REPEATED`). All of it comes from the table: the reach within which close rows exceed chance, the
errors S from the distances of close rows, ρ from the neighbours of an object and f from the objects, in two rounds.

The partition is the best that dividing, moving and merging find within components of rows that reach each other
(:mod:`sameas.kernels.internal`). Of two rows, its probabilities are those of all partitions; of more, those of other
places of one row, of exchanges of two, and of the divisions and unions of an object.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import MaskedColumn, Table
from numpy.typing import NDArray
from scipy.special import gammaln

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.error_model import better_model
from sameas.evidence import Errors
from sameas.gate import Radius
from sameas.gaussian import inverse
from sameas.kernels import threads
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky.catalogue import Catalogue
from sameas.sky.column_choice import PositionError
from sameas.sky.crossmatch import by_position, error_factor, refuse_unusable, typical_sigma_arcsec
from sameas.sky.output_columns import attributes_of, free_name
from sameas.space import ARCSEC_PER_RADIAN, displaced, on_axes_of, unit_vectors

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

#: Radii at which neighbours are counted, arcsec: from the first to the last by this factor; records that count them;
#: most chance neighbours of a record within the reach, and most neighbours that are counted.
RADII_ARCSEC, RADIUS_STEP, COUNTED, MOST_BY_CHANCE, MOST_COUNTED = (1e-3, 240.0), math.sqrt(2.0), 2e5, 2.0, 5e4
#: The reach has this share of the close couples in excess of chance; an excess counts from this many standard
#: deviations on. Rows are linked at LINK times the reach, which loses none, or where they have MOST_LINKED unrelated
#: objects within it: at four times as many, chance links all.
EXCESS_SHARE, MIN_EXCESS_SIGMAS, LINK, MOST_LINKED = 0.98, 5.0, 2.0, 1.0
#: Least number of couples of rows from which errors are estimated; typical errors within which rows are linked where
#: the table shows no excess.
MIN_COUPLES, LINKED_SIGMAS = 30, 8.0
#: About this many couples of rows tell the errors, and of these the floor; within how many reaches, four radii more.
COUPLES, MODEL_PAIRS, WITHIN = 300_000, 3_000, RADIUS_STEP**4
#: The distance of the farthest couples over the largest scale of the errors, the ratio of the next smaller one, and
#: their number; bins of the distance; EM steps; least share of a scale.
LARGEST, SCALE_STEP, N_SCALES, BINNED, EM_STEPS, LEAST_SHARE = 2.5, 1.25, 14, 500, 2_000, 3e-3
MIN_GAIN_OF_FLOOR = 8.0  # in ln likelihood
#: Close rows whose distances are more than this many times the quoted errors, of fewer rows than this share, are two
#: objects each.
FAR_WIDER, FEW = 10.0, 0.2
#: Error per axis that is assumed before it is estimated, as a share of the reach (3σ of a difference is 4.2σ).
ERROR_OF_REACH = 1.0 / 4.2
BINS = 4  # of the number of rows of an object, per octave
ROUNDS = 2  # of the density and of f(K)
NEIGHBOURS = 16  # of an object, for the density
#: Times are those of exposures if there are at most this many for a row, and at most this share of the rows has that of
#: its nearest row.
LARGEST_SHARE_OF_TIMES, MOST_AT_ONE_TIME = 0.5, 0.2
REPEATED = 1e-3  # probability that an exposure shows an object twice (deblenders; chosen)
WIDE = 1.5  # scale from which a component of the errors is one of the outliers
SEED = 20_261


@in_short
@dataclass(frozen=True)
class InternalOptions:
    """error_scale : "auto" estimates the errors; 1 takes them as quoted, a number as quoted times it.
    exposure : the column that numbers the exposures, images or visits; an exposure shows an object once. Without it,
        rows of one time are of one exposure, if hardly any of them lie together."""

    error_scale: float | str = "auto"
    exposure: str | None = None

    def check(self) -> None:
        """Refuse invalid values, before a file is read."""
        error_factor(self.error_scale)


@in_short
@dataclass(frozen=True)
class InternalMatch:
    """The objects of one table; n usable records, g objects.

    records : the usable rows, with errors as estimated. reach_arcsec : within which rows of one object lie. chance :
    expected unrelated neighbours of a row within it. errors : relative to the quoted ones, the mixture of one row.
    object : (n,) number of the object of each record; objects are numbered by their first rows in the table.
    p_row : (n,) probability that the row is of this object. p_object : (g,) that these rows are one object, and not two
    or a part of a neighbour. position_deg : (g, 2) right ascension and declination. covariance : (g, 2, 2) of east and
    north, arcsec². exposures : their number, 0 if they are not known. doubts : what looks wrong.
    """

    catalogue: Catalogue
    records: Records
    reach_arcsec: float
    chance: float
    errors: Errors
    object: IntArray
    p_row: FloatArray
    p_object: FloatArray
    position_deg: FloatArray
    covariance: FloatArray
    exposures: int
    doubts: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.p_object)

    @cached_property
    def n_rows(self) -> IntArray:
        """(g,) rows of each object."""
        return np.bincount(self.object, minlength=len(self))

    @cached_property
    def offset_arcsec(self) -> FloatArray:
        """(n, 2) east and north of each record from the place of its object."""
        return on_axes_of(self.position_deg[self.object], self.records.features)[0]

    @property
    def tail_share(self) -> float:
        """Share of the rows with errors far larger than the typical ones."""
        return sum(share for scale, share in zip(self.errors.scales, self.errors.shares, strict=True) if scale > WIDE)

    @cached_property
    def chi_sq(self) -> FloatArray:
        """(g,) χ² of the rows about the place, of 2 (n_rows − 1) degrees of freedom."""
        precision = inverse(self.records.full_covariance())
        square = np.einsum("nv,nvw,nw->n", self.offset_arcsec, precision, self.offset_arcsec)
        return np.bincount(self.object, square, len(self)).astype(np.float64)

    @cached_property
    def rank(self) -> IntArray:
        """(n,) place of the record among those of its object, from the smallest error, counted from 1."""
        size = self.records.variances.sum(axis=1)
        order = np.lexsort([self.records.rows, size, self.object])
        out = np.empty(len(order), np.int64)
        out[order] = Ragged.of_sizes(self.n_rows).index + 1
        return out


def match_internal(
    catalogue: Catalogue,
    options: InternalOptions | None = None,
    *,
    progress: Callable[[str], None] = lambda stage: None,
) -> InternalMatch:
    """The rows of a table gathered to objects, with everything estimated from the table.

    Raises
    ------
    InputError : no usable rows; the exposure column does not exist.
    """
    options = InternalOptions() if options is None else options
    factor, unknown = error_factor(options.error_scale), catalogue.error_is_unknown
    doubts: tuple[str, ...] = ()
    progress("neighbours")
    known = catalogue.with_error(PositionError("number", sigma_arcsec=1.0, reason="assumed")) if unknown else catalogue
    records = known.records(known.epoch_jyr if known.has_motion else None)
    refuse_unusable(known, records)
    records = by_position(records)
    neighbours = _Neighbours.of(records)
    if unknown:
        records = records.with_errors(ERROR_OF_REACH * max(neighbours.reach_arcsec, RADII_ARCSEC[0]), 0.0)
    if options.exposure is not None:
        exposures = _exposures_of_column(catalogue, records, options.exposure)
    else:
        exposures = _exposures_by_time(catalogue.astrometry.epoch_jyr[records.rows], neighbours)
    progress("errors")
    if factor is not None:
        errors = Errors(factor_1=factor, factor_2=factor)
    else:
        errors, neighbours, doubts = _judged(catalogue, records, neighbours)
    progress("objects")
    link = neighbours.link_arcsec
    if not link and not unknown:
        link = LINKED_SIGMAS * math.sqrt(2.0) * typical_sigma_arcsec(records)
    records, _ = errors.records(records, records)
    found = _Partition.of(records, _components(neighbours.tree.data, link), exposures, errors)
    return found.result(catalogue, neighbours, errors, int(exposures.max()) + 1, doubts)


def _judged(
    catalogue: Catalogue, records: Records, neighbours: _Neighbours
) -> tuple[Errors, _Neighbours, tuple[str, ...]]:
    """The errors of the rows, the neighbours that are rows of one object, and doubts about both."""
    name, reach = catalogue.name, neighbours.reach_arcsec
    if not reach:
        none = f"{name}: close rows do not exceed what chance gives: hardly any object is repeated"
        return Errors(), neighbours, (none,)
    # Copies of rows, nearer than the first radius, tell nothing of errors.
    errors = _errors_of_rows(records, neighbours) if reach > RADII_ARCSEC[0] else Errors()
    sigma = typical_sigma_arcsec(errors.records(records, records)[0])
    if catalogue.error_is_unknown:
        assumed = f"{sigma:.2g} arcsec on each axis was estimated from the distances of its rows to each other"
        return errors, neighbours, (f"{name}: it has no position errors; {assumed}",)
    wider = sigma / typical_sigma_arcsec(records)
    if wider < FAR_WIDER or neighbours.excess > FEW:
        return errors, neighbours, ()
    doubt = (
        f"{name}: {100.0 * neighbours.excess:.1g} % of its rows have another within {reach:.2g} arcsec in excess of "
        f"chance, {wider:,.0f} times as far as the errors quoted; they were taken for two objects each (double stars), "
        "and not for rows of one"
    )
    return Errors(), replace(neighbours, reach_arcsec=0.0), (doubt,)


def _exposures_of_column(catalogue: Catalogue, records: Records, name: str) -> IntArray:
    """(n,) numbers of the exposures of the records, by the column of this name; −1 where it has none."""
    column_name = catalogue.column_named(name)
    if column_name is None:
        names = ", ".join(catalogue.table.colnames[:12])
        raise InputError(f"{catalogue.name}: there is no column {name!r}; its columns are {names}",
                         "name the column of the exposures")  # fmt: skip
    column = np.ma.asarray(catalogue.table[column_name])[records.rows]
    values, known = np.ma.getdata(column), ~np.ma.getmaskarray(column)
    if values.dtype.kind == "f":
        known &= np.isfinite(values)
    elif values.dtype.kind == "O":
        values = values.astype(str)
    return _numbered(values, known)


def _exposures_by_time(epoch_jyr: FloatArray, neighbours: _Neighbours) -> IntArray:
    """(n,) numbers of the times of the records, where these are of exposures: many rows share one, but hardly any
    shares it with its nearest row; else −1."""
    known = np.isfinite(epoch_jyr)
    number, none = _numbered(epoch_jyr, known), np.full(len(epoch_jyr), -1)
    if not neighbours.reach_arcsec or not 0 < number.max() < LARGEST_SHARE_OF_TIMES * np.count_nonzero(known):
        return none
    nearest, distance_arcsec = neighbours.nearest
    near = known & known[nearest] & (distance_arcsec < neighbours.reach_arcsec)
    at_once = float(np.mean(number[near] == number[nearest[near]])) if near.any() else 1.0
    return number if at_once <= MOST_AT_ONE_TIME else none


def _numbered(values: NDArray[Any], known: BoolArray) -> IntArray:
    """(n,) numbers of different known values in their order; −1 of the others."""
    out = np.full(len(values), -1)
    out[known] = np.unique(values[known], return_inverse=True)[1]
    return out


@dataclass(frozen=True)
class _Neighbours:
    """tree : of the directions (n, 3) of the records. reach_arcsec : 0 if close rows do not exceed chance. chance : see
    :class:`InternalMatch`. within, excess : mean number of other rows within WITHIN times the reach, and of those
    within the reach beyond chance."""

    tree: cKDTree
    reach_arcsec: float
    chance: float
    within: float = 0.0
    excess: float = 0.0

    @property
    def nearest(self) -> tuple[IntArray, FloatArray]:
        """(n,) the nearest other record of each, and (n,) its distance in arcsec."""
        distance, at = self.tree.query(self.tree.data, k=2, workers=-1)
        first = at[:, 0] != np.arange(len(at))  # of two records at one place either comes first
        return np.where(first, at[:, 0], at[:, 1]), distance[:, 1] * ARCSEC_PER_RADIAN

    @property
    def link_arcsec(self) -> float:
        """Within which rows are linked: twice the reach, less where chance would link whole fields."""
        return self.reach_arcsec * min(LINK, math.sqrt(MOST_LINKED / max(self.chance, 1e-9)))

    @classmethod
    def of(cls, records: Records) -> _Neighbours:
        """From the numbers of neighbours at all radii; those of twice to four times a radius tell the density."""
        from scipy.spatial import cKDTree

        direction = unit_vectors(*records.features.T)
        mixed = direction[np.random.default_rng(SEED).permutation(len(direction))]
        tree, radius = cKDTree(direction), RADII_ARCSEC[0]
        radii: list[float] = []
        counts: list[float] = []
        centres: list[int] = []
        while radius <= RADII_ARCSEC[1] and (not counts or counts[-1] < MOST_COUNTED):
            some = mixed[: int(COUNTED / (1.0 + 2.0 * counts[-1] if counts else 1.0))]
            number = tree.query_ball_point(some, radius / ARCSEC_PER_RADIAN, return_length=True, workers=-1)
            radii.append(radius)
            counts.append(float(number.mean()) - 1.0)
            centres.append(len(some))
            radius *= RADIUS_STEP
        excess, by_chance = np.zeros(len(counts)), np.zeros(len(counts))
        for k in range(len(counts) - 4):
            chance = max((counts[k + 4] - counts[k + 2]) / 12.0, 0.0)
            more = counts[k] - chance
            # Rows of one object are near others together.
            by_chance[k] = chance / (1.0 + max(more, 0.0))
            significant = more > MIN_EXCESS_SIGMAS * math.sqrt((counts[k] + chance) / centres[k])
            excess[k] = more if significant and by_chance[k] < MOST_BY_CHANCE else 0.0
        # The excess grows up to the reach, and at twice of it is the same, but for the objects that chance puts there,
        # whose rows come together.
        together = 1.0 + np.maximum(excess, 0.0)
        couples = len(records) * 1.5 * by_chance / together
        scatter = 2.0 * together**2 * np.sqrt(couples) / len(records)
        growth = excess[2:] - excess[:-2]
        levels_off = (excess[:-2] > 0.0) & (growth <= (1.0 - EXCESS_SHARE) * excess[:-2] + 2.0 * scatter[:-2])
        if not levels_off.any():
            return cls(tree, 0.0, 0.0)
        reached = int(np.argmax(levels_off))
        return cls(tree, radii[reached], float(by_chance[reached]), counts[reached + 4], float(excess[reached]))


def _components(direction: FloatArray, link_arcsec: float) -> IntArray:
    """(n,) components of rows within ``link_arcsec`` of each other, by occupied cells of half that size."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not link_arcsec > 0.0:
        return np.arange(len(direction))
    length = link_arcsec / ARCSEC_PER_RADIAN
    _, cell = np.unique(np.floor(direction / (0.5 * length)).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    number = np.bincount(cell)
    middle = np.column_stack([np.bincount(cell, axis) for axis in direction.T]) / number[:, None]
    pairs = cKDTree(middle).query_pairs(length, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(number), len(number)))
    return np.asarray(connected_components(graph, directed=False)[1][cell])


def _errors_of_rows(records: Records, neighbours: _Neighbours) -> Errors:
    """The errors of one row relative to the quoted ones, from the distances of close rows.

    Distances of rows of one object are those of a mixture of normals, those of others increase in proportion to the
    distance. The shares of both are fitted by EM iterations; the likelihood has one maximum.
    """
    sigma = math.sqrt(2.0) * typical_sigma_arcsec(records)
    enough = int(COUPLES / (1.0 + neighbours.within))
    some = np.sort(np.random.default_rng(SEED).permutation(len(records))[: max(enough, MIN_COUPLES)])
    limit = WITHIN * neighbours.reach_arcsec / sigma
    pairs = Radius(limit)(records.part(some), records)
    pairs = pairs.part(pairs.first.rows[pairs.i] != pairs.second.rows[pairs.j])
    if len(pairs) < MIN_COUPLES:
        return Errors()
    mixture, p_same = _mixture(pairs.mahalanobis_sq, limit)
    model, gain = better_model(mixture, pairs, p_same, MODEL_PAIRS)
    if model.floor and gain > MIN_GAIN_OF_FLOOR:
        mixture = model.with_mixture(_mixture(model.pairs(pairs).mahalanobis_sq, limit)[0])
    return _of_one(mixture)


def _mixture(square: FloatArray, limit: float) -> tuple[Errors, FloatArray]:
    """The scales of the errors of couples, by squared normalised distances (m,) up to ``limit``, and the probability
    (m,) of each to be of one object."""
    scales = limit / LARGEST / SCALE_STEP ** np.arange(N_SCALES)
    # In bins, so that many EM steps take no time: a tail needs hundreds.
    edges = np.linspace(0.0, limit, BINNED + 1) ** 2
    in_bin = np.minimum(np.searchsorted(edges, square, side="right") - 1, BINNED - 1)
    count = np.bincount(in_bin, minlength=BINNED) / len(square)
    of_same = -np.diff(np.exp(-0.5 * edges[:, None] / scales**2), axis=0)
    density = np.column_stack([of_same, np.diff(edges) / limit**2])
    share = np.full(N_SCALES + 1, 1.0 / (N_SCALES + 1))
    for _ in range(EM_STEPS):
        part = density * share
        part /= part.sum(axis=1, keepdims=True)
        share = count @ part
    kept = share[:-1] > LEAST_SHARE * share[:-1].sum()
    shares = share[:-1][kept] / share[:-1][kept].sum()
    return Errors(tuple(scales[kept].tolist()), tuple(shares.tolist())), 1.0 - part[in_bin, -1]


def _of_one(errors: Errors) -> Errors:
    """The errors of one row from those of the difference of two: an outlier is one of the two. The floor stays that of
    two, of which each has half the variance."""
    typical = errors.typical_scale
    relative = np.array(errors.scales) / typical
    wide = relative > WIDE
    scales = np.where(wide, np.sqrt(np.maximum(2.0 * relative**2 - 1.0, 1.0)), relative)
    shares = np.where(wide, 0.5, 1.0) * np.array(errors.shares)
    factor = typical * math.sqrt(0.5 * (errors.factor_1**2 + errors.factor_2**2))
    shares /= shares.sum()
    floor = typical * float(np.max(errors.floor))
    return Errors(tuple(scales.tolist()), tuple(shares.tolist()), factor, factor, floor)


@dataclass(frozen=True)
class _Partition:
    """The partition of records, (n,), sorted by component.

    order : (n,) of the records. origin : (n, 2) place of the first record of each component, degrees. label : number of
    the object, over all components. place : (n, 5) of the object from the origin, and its precision.
    """

    records: Records
    order: IntArray
    origin: FloatArray
    label: IntArray
    p_row: FloatArray
    p_object: FloatArray
    place: FloatArray

    @classmethod
    def of(cls, records: Records, component: IntArray, exposure: IntArray, errors: Errors) -> _Partition:
        """The best partition found, with densities and numbers of rows that fit it."""
        from sameas.kernels.internal import RowModel

        order = np.argsort(component, kind="stable")
        parts = Ragged.of_sorted(component[order], int(component.max()) + 1)
        start, sizes = parts.start, parts.sizes
        first = np.repeat(order[start[:-1]], sizes)
        origin = records.features[first]
        xy, rotation = on_axes_of(origin, records.features[order])
        covariance = records.full_covariance()[order]
        if records.covariance.shape[1] > 1:
            covariance = np.einsum("nvw,nwx,nyx->nvy", rotation, covariance, rotation)
        precision = inverse(covariance)[:, [0, 0, 1], [0, 1, 1]]
        rows = xy, np.ascontiguousarray(precision), exposure[order]
        most, number = int(sizes.max()), int(exposure.max()) + 1
        of_bin = np.unique(np.floor(BINS * np.log2(np.arange(1, most + 1))), return_inverse=True)[1]
        share = np.ones(of_bin[-1] + 1)
        scales, shares = np.array(errors.scales), np.array(errors.shares)
        label, place = np.zeros(len(order), np.int64), np.zeros((len(order), 5))
        p_row, p_object, alternative = np.ones(len(order)), np.ones(len(order)), np.zeros((len(order), 4))
        bounds = parts.bounds(len(threads.even(len(order))) - 1)
        middle = origin[start[:-1]]
        for _ in range(ROUNDS):
            log_density = np.log(_density(middle, origin[start[:-1]]))
            model = RowModel(_log_count(share, of_bin, number), scales, shares, math.log(REPEATED))
            alternative[:] = 0.0
            out = label, p_row, p_object, place, alternative
            threads.over(partial(_filled, (start, *rows, log_density, model, *out)), bounds)
            counts = np.maximum.reduceat(label, start[:-1]) + 1
            in_all = label + np.repeat(np.cumsum(counts) - counts, sizes)
            _, firsts, n_rows = np.unique(in_all, return_index=True, return_counts=True)
            middle = displaced(origin[firsts], place[firsts, :2])
            share = _expected_counts(n_rows, alternative[firsts], of_bin) + 0.5
        return cls(records, order, origin, in_all, p_row, p_object, place)

    def result(
        self, catalogue: Catalogue, neighbours: _Neighbours, errors: Errors, exposures: int, doubts: tuple[str, ...]
    ) -> InternalMatch:
        """With the objects numbered by their first rows in the table."""
        rows = self.records.rows[self.order]
        by_row = np.argsort(rows)
        _, first, number = np.unique(self.label[by_row], return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        at = by_row[np.sort(first)]
        of_record = np.empty(len(rows), np.int64)
        of_record[self.order[by_row]] = rank[number.ravel()]
        p_row = np.empty(len(rows))
        p_row[self.order] = self.p_row
        precision = np.empty((len(at), 2, 2))
        precision[:, [0, 0, 1, 1], [0, 1, 0, 1]] = self.place[at][:, [2, 3, 3, 4]]
        return InternalMatch(
            catalogue, self.records, neighbours.reach_arcsec, neighbours.chance, errors, of_record, p_row,
            self.p_object[at], displaced(self.origin[at], self.place[at, :2]), inverse(precision), exposures, doubts,
        )  # fmt: skip


def _filled(arguments: tuple[Any, ...], first: int, last: int) -> None:
    """Fill the arrays for a range of components."""
    from sameas.kernels.internal import partition

    partition(first, last, *arguments)


def _density(objects_deg: FloatArray, at_deg: FloatArray) -> FloatArray:
    """(m,) density of other objects (g, 2) per arcsec² at places (m, 2), from the distance of a near neighbour."""
    from scipy.spatial import cKDTree

    k = min(NEIGHBOURS, len(objects_deg) - 1)
    if k < 2:
        return np.full(len(at_deg), 1.0 / 3600.0**2)
    distance, _ = cKDTree(unit_vectors(*objects_deg.T)).query(unit_vectors(*at_deg.T), k=[k + 1], workers=-1)
    radius = np.maximum(distance[:, 0] * ARCSEC_PER_RADIAN, 1e-6)
    return np.asarray((k - 1) / (math.pi * radius**2))


def _expected_counts(n_rows: IntArray, alternative: FloatArray, of_bin: IntArray) -> FloatArray:
    """Expected objects by bin of their number of rows. n_rows : (g,) of the best partition. alternative : (g, 4) of
    their divisions and unions, as of :func:`sameas.kernels.internal.partition`.

    Numbers of the best partition alone would support themselves: two objects taken for one of twice as many rows make
    such objects more probable.
    """
    p_two, p_union = alternative[:, 0], alternative[:, 2]
    second, with_rows = alternative[:, 1].astype(np.int64), alternative[:, 3].astype(np.int64)
    counts = np.zeros(of_bin[-1] + 1)
    for number, weight in (
        (n_rows, 1.0 - p_two - p_union),
        (n_rows - second, p_two),
        (second, p_two),
        (n_rows + with_rows, 0.5 * p_union),
    ):
        some = (weight > 0.0) & (number > 0)
        counts += np.bincount(of_bin[np.minimum(number[some], len(of_bin)) - 1], weight[some], len(counts))
    return counts


def _log_count(share: FloatArray, of_bin: IntArray, exposures: int) -> FloatArray:
    """(m + 1,) c(K) = ln f(K) + ln K!, or − ln (T over K) with exposures; f is even within a bin of K."""
    rows = np.arange(1, len(of_bin) + 1)
    log_f = np.log(share / share.sum() / np.bincount(of_bin))[of_bin]
    if exposures:
        total = max(exposures, len(rows))
        log_ways = -(gammaln(total + 1.0) - gammaln(rows + 1.0) - gammaln(total - rows + 1.0))
    else:
        log_ways = gammaln(rows + 1.0)
    return np.concatenate([[0.0], log_f + log_ways])


def rows_table(match: InternalMatch) -> Table:
    """The table of the catalogue with the object of each row.

    object_id : number of the object, counted from 1 in the order of first rows. object_rows : number of its rows.
    object_rank : 1 for its row of the smallest error, and so on. object_sep_arcsec : distance from its mean place.
    p_row : probability that the row is of this object. p_object : that exactly these rows are one object. All are
    masked in rows that could not be used.
    """
    table = match.catalogue.table.copy(copy_data=False)
    at = match.object
    values = {
        "object_id": at + 1, "object_rows": match.n_rows[at], "object_rank": match.rank,
        "object_sep_arcsec": np.hypot(*match.offset_arcsec.T), "p_row": match.p_row, "p_object": match.p_object[at],
    }  # fmt: skip
    rows = match.records.rows
    unused = np.ones(len(table), np.bool_)
    unused[rows] = False
    for name, of_records in values.items():
        column = np.zeros(len(table), of_records.dtype)
        column[rows] = of_records
        table[free_name(name, table.colnames)] = MaskedColumn(column, mask=unused, **attributes_of(name))
    return table


def objects_table(match: InternalMatch) -> Table:
    """One row for each object, as a catalogue that ``sameas match`` reads.

    object_id, ra, dec, ra_error_arcsec, dec_error_arcsec : mean place of its rows. object_rows, p_object : see
    :func:`rows_table`. chi_sq : of its rows, 2 (object_rows − 1) degrees of freedom. epoch, epoch_first, epoch_last :
    where rows have epochs. The mean magnitude has the name of the rows' column, and ``…_scatter`` is the standard
    deviation of two or more.
    """
    sigma = np.sqrt(np.einsum("gvv->gv", match.covariance))
    values: dict[str, Any] = {
        "object_id": np.arange(1, len(match) + 1), "ra": match.position_deg[:, 0], "dec": match.position_deg[:, 1],
        "ra_error_arcsec": sigma[:, 0], "dec_error_arcsec": sigma[:, 1], "object_rows": match.n_rows,
        "p_object": match.p_object, "chi_sq": match.chi_sq,
    }  # fmt: skip
    rows = match.records.rows
    epoch = match.catalogue.astrometry.epoch_jyr[rows]
    if np.isfinite(epoch).any():
        first, last = _extremes(match, epoch)
        values |= {"epoch": _mean_and_scatter(match, epoch)[0], "epoch_first": first, "epoch_last": last}
    table = Table()
    for name, of_objects in values.items():
        table[name] = MaskedColumn(of_objects, mask=~np.isfinite(of_objects), **attributes_of(name))
    magnitude, band = match.catalogue.magnitude, match.catalogue.magnitude_name
    if magnitude is not None and band is not None:
        named = zip((band, f"{band}_scatter"), ("magnitude_mean", "magnitude_scatter"), strict=True)
        for (of_column, kind), of_objects in zip(named, _mean_and_scatter(match, magnitude[rows]), strict=True):
            attributes = attributes_of(kind)
            table[free_name(of_column, table.colnames)] = MaskedColumn(
                of_objects, mask=~np.isfinite(of_objects), **attributes
            )
    return table


def _mean_and_scatter(match: InternalMatch, of_rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(g,) mean of the finite values of the rows, and (g,) their standard deviation; NaN of none, and of one."""
    known = np.isfinite(of_rows)
    at, value, n = match.object[known], of_rows[known], len(match)
    number = np.bincount(at, minlength=n)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(at, value, n) / number
        scatter = np.sqrt(np.bincount(at, (value - mean[at]) ** 2, n) / (number - 1))
    return mean, np.where(number > 1, scatter, np.nan)


def _extremes(match: InternalMatch, of_rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(g,) least and greatest of the finite values of the rows; NaN of none."""
    low, high = np.full(len(match), np.inf), np.full(len(match), -np.inf)
    known = np.isfinite(of_rows)
    np.minimum.at(low, match.object[known], of_rows[known])
    np.maximum.at(high, match.object[known], of_rows[known])
    return np.where(np.isfinite(low), low, np.nan), np.where(np.isfinite(high), high, np.nan)
