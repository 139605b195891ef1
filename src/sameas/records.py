"""Records: the positions and errors given by one source, checked once, here.

All later stages rely on the checks: positions are finite, covariances positive definite, ids unique. Unusable rows (no
position, no error) are set aside with the reason and appear in the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, taken
from sameas.errors import InputError
from sameas.kernels.compiled import runs_compiled
from sameas.representation import counted, in_short
from sameas.space import Plane, Space, Sphere

#: Up to this many rows are checked one by one by compiled kernels; NumPy is faster for more (measured).
FEW = 256


@in_short
@dataclass(frozen=True)
class SetAside:
    """Unusable rows: ``rows`` (k,) of the source's table, and the reason for each in words."""

    rows: IntArray
    reasons: NDArray[np.object_]

    def counts(self) -> dict[str, int]:
        """Number of rows by reason."""
        reasons, counts = np.unique(self.reasons.astype(str), return_counts=True)
        return {str(reason): int(count) for reason, count in zip(reasons, counts, strict=True)}


#: No row is set aside.
NONE_ASIDE = SetAside(np.empty(0, np.int64), np.empty(0, object))


@in_short
@dataclass(frozen=True)
class Records:
    """The usable records of one source. Make them with :meth:`Records.of`.

    Attributes
    ----------
    features : (n, d) positions in ``space``.
    covariance : (n, p) packed error covariances in the space's residual unit, squared: p = 1 one variance for
        all axes, p = d one variance per axis, p = d(d+1)/2 the upper triangle row by row (xx, xy, …, yy, …).
    rows : (n,) row of each record in the source's own table, in any order.
    ids : (n_table,) the source's own identifiers, unique, indexed by table row.
    space : how residuals are formed.
    source : the name of the source, used in messages.
    table : the user's own table or None; not used by the core.
    set_aside : unusable rows.
    """

    features: FloatArray
    covariance: FloatArray
    rows: IntArray
    ids: NDArray[Any]
    space: Space = field(default_factory=Plane)
    source: str = "source"
    table: Any = None
    set_aside: SetAside = field(default=NONE_ASIDE)

    def __len__(self) -> int:
        return len(self.features)

    @property
    def d(self) -> int:
        """Number of features."""
        return int(self.features.shape[1])

    def over_table(self, values: BoolArray) -> BoolArray:
        """(n_table,) booleans of the records at their rows, True for unusable rows."""
        column = np.ones(self.n_table, np.bool_)
        column[self.rows] = values
        return column

    def at_row(self, row: int) -> int | None:
        """Index of the record of a table row, None if the row is unusable."""
        at = np.flatnonzero(self.rows == row)
        return int(at[0]) if len(at) else None

    @property
    def n_table(self) -> int:
        """Number of rows of the source's table, including unusable ones."""
        return len(self.ids)

    @classmethod
    def of(
        cls,
        features: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        variance: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        ids: Sequence[Any] | NDArray[Any] | None = None,
        space: Space | None = None,
        source: str = "source",
        table: Any = None,
        invalid: str = "refuse",
    ) -> Records:
        """Records from positions and their errors, checked.

        Parameters
        ----------
        features : (n, d), or (n,) for one feature. A masked or non-finite cell sets its row aside.
        sigma : one standard deviation for all, (n,) one per record, (d,) when n ≠ d one per feature, or (n, d).
        variance : the same shapes, squared.
        covariance : (d, d) for all, or (n, d, d).
            Exactly one of the three is given. Unit: that of the features; on a :class:`Sphere` arcsec (east, north).
        ids : (n,) unique identifiers; the row numbers if not given.
        space : :class:`Plane` (default) or :class:`Sphere`.
        source : name used in messages.
        table : carried along for the caller.
        invalid : "refuse" raises on an error that is zero, negative or not positive definite;
            "set aside" treats such rows like rows without an error.

        Raises
        ------
        InputError : wrong shapes, no or several kinds of errors, bad errors, duplicate ids; errors so far from 1 that
            the determinant of a covariance is no number.
        """
        space = Plane() if space is None else space
        values = _as_float(features, source, "features")
        if values.ndim == 1:
            values = values[:, None]
        values = np.ascontiguousarray(values)
        if values.ndim != 2 or values.shape[1] == 0:
            raise InputError(f"{source}: features have shape {values.shape}; give (rows, features)")
        n, d = values.shape
        if isinstance(space, Sphere) and d != 2:
            raise InputError(f"{source}: a direction has 2 features (longitude, latitude in degrees), got {d}")
        if isinstance(space, Plane):
            space.period_list(d)
        packed = _packed_covariance(sigma, variance, covariance, n, d, source)
        reasons = _unusable(values, packed, space, d, source, invalid)
        about = {"ids": _checked_ids(ids, n, source), "space": space, "source": source, "table": table}
        if reasons is None:
            records = cls(values, packed, about["ids"] if ids is None else np.arange(n), **about)
        else:
            keep, aside = np.flatnonzero(reasons == 0), np.flatnonzero(reasons)
            set_aside = SetAside(aside, _REASONS[reasons[aside]])
            records = cls(values[keep], packed[keep], keep, **about, set_aside=set_aside)
        _refuse_extremes(records)
        return records

    @property
    def variances(self) -> FloatArray:
        """(n, d) variances along the axes, or (n, 1) if they are equal on all axes."""
        p, d = self.covariance.shape[1], self.d
        if p <= d:
            return self.covariance
        return self.covariance[:, _diagonal(d)]

    def full_covariance(self) -> FloatArray:
        """(n, d, d) covariances, unpacked."""
        return unpack(self.covariance, self.d)

    def part(self, some: IntArray) -> Records:
        """The records with these indices (k,); table and rows stay the same."""
        return replace(
            self,
            features=taken(self.features, some), covariance=taken(self.covariance, some), rows=taken(self.rows, some),
        )  # fmt: skip

    def with_errors(self, factor: float, variance: ArrayLike) -> Records:
        """The records with errors multiplied by ``factor``, and ``variance`` added along the axes.

        variance : a number, (d,) per axis, or (n, 1) or (n, d) per record.
        """
        d, p = self.d, self.covariance.shape[1]
        added, packed = np.asarray(variance, np.float64), factor**2 * self.covariance
        if p == 1 and added.ndim and added.shape[-1] > 1:
            packed = np.repeat(packed, d, axis=1)
        packed[:, slice(None) if p <= d else _diagonal(d)] += added
        return replace(self, covariance=packed)


_REASONS = np.array(["", "no position", "no error", "error not positive", "latitude beyond ±90°"], dtype=object)


def unpack(packed: FloatArray, d: int) -> FloatArray:
    """(n, d, d) matrices from packed covariances (n, p); see :class:`Records`."""
    n, p = packed.shape
    full = np.zeros((n, d, d))
    if p in (1, d):
        axis = np.arange(d)
        full[:, axis, axis] = packed
        return full
    for at, (v, w) in enumerate(combinations_with_replacement(range(d), 2)):
        full[:, v, w] = full[:, w, v] = packed[:, at]
    return full


def _as_float(values: ArrayLike, source: str, what: str) -> FloatArray:
    if isinstance(values, np.ma.MaskedArray):
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: {what} are not numbers ({error})") from None


def _packed_covariance(
    sigma: ArrayLike | None, variance: ArrayLike | None, covariance: ArrayLike | None, n: int, d: int, source: str
) -> FloatArray:
    given = [
        name for name, v in (("sigma", sigma), ("variance", variance), ("covariance", covariance)) if v is not None
    ]
    if len(given) != 1:
        raise InputError(f"{source}: give one of sigma, variance, covariance; got {' and '.join(given) or 'none'}")
    if covariance is not None:
        return _packed_matrices(_as_float(covariance, source, "covariances"), n, d, source)
    values = _as_float(sigma if sigma is not None else variance, source, given[0])  # type: ignore[arg-type]
    if values.ndim == 0:
        spread = np.full((n, 1), float(values))
    elif values.shape == (n,):
        spread = values[:, None].copy()
    elif values.shape == (d,):
        spread = np.broadcast_to(values, (n, d)).copy()
    elif values.shape in ((n, d), (n, 1)):
        spread = values.copy()
    else:
        raise InputError(
            f"{source}: {given[0]} has shape {values.shape}; give one number, ({n},), ({d},) or ({n}, {d})"
        )
    # The square keeps the sign, so that a negative sigma is refused below.
    return spread * np.abs(spread) if sigma is not None else spread


def _packed_matrices(matrices: FloatArray, n: int, d: int, source: str) -> FloatArray:
    if matrices.shape == (d, d):
        matrices = np.broadcast_to(matrices, (n, d, d))
    if matrices.shape != (n, d, d):
        raise InputError(f"{source}: covariance has shape {matrices.shape}; give ({d}, {d}) or ({n}, {d}, {d})")
    from sameas.kernels.records import pack

    packed = np.empty((n, d * (d + 1) // 2))
    if not pack(np.ascontiguousarray(matrices), packed):
        with np.errstate(invalid="ignore"):
            skew = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
            size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
            lopsided = np.flatnonzero(skew > 1e-9 * size)
        if len(lopsided):
            raise InputError(f"{source}: {len(lopsided)} covariances are not symmetric (first: row {lopsided[0]})")
    return packed


def _unusable(
    values: FloatArray, packed: FloatArray, space: Space, d: int, source: str, invalid: str
) -> NDArray[np.int8] | None:
    """(n,) 0 for usable rows, else the index of the reason; None if all rows are usable."""
    from sameas.kernels.records import BEYOND_POLE, NOT_POSITIVE, check_rows

    if invalid not in ("refuse", "set aside"):
        raise InputError(f'{source}: invalid={invalid!r}; give "refuse" or "set aside"')
    # For few rows, a compiled kernel takes less time than NumPy's call overhead.
    few = len(values) <= FEW and runs_compiled(check_rows)
    if not few and _all_usable(values, packed, isinstance(space, Sphere)):
        return None
    reasons = np.empty(len(values), np.int8)
    if not check_rows(values, packed, isinstance(space, Sphere), reasons):
        return None
    if invalid == "refuse":
        wrong = np.flatnonzero(reasons == NOT_POSITIVE)
        if len(wrong):
            raise InputError(_not_positive(packed, wrong, d, source))
        beyond = np.flatnonzero(reasons == BEYOND_POLE)
        if len(beyond):
            raise InputError(
                f"{source}: {len(beyond)} latitudes lie beyond ±90° (row {beyond[0]}: {values[beyond[0], 1]:g}); "
                "give longitude, latitude in degrees"
            )
    return reasons


def _diagonal(d: int) -> slice | list[int]:
    """Where packed (d, d) covariances have their variances."""
    # A view takes a fifth of the time of a list, which counts for few records.
    return slice(0, None, 2) if d == 2 else list(accumulate(range(d, 1, -1), initial=0))


#: Greatest |ln| of a product of variances: a double ends at 709, and a pair has the sum of two covariances.
_MAX_LOG_PRODUCT = 600.0


def _refuse_extremes(records: Records) -> None:
    """Raise InputError if the variances are so large or small that |Σ| of a pair overflows or underflows."""
    if not len(records):
        return
    variances = records.variances
    least, most = float(variances.min()), float(variances.max())
    if records.d * max(math.log(most), -math.log(least)) > _MAX_LOG_PRODUCT:
        raise InputError(
            f"{records.source}: errors of {math.sqrt(least):.3g} to {math.sqrt(most):.3g} in {records.d} features have "
            "no product that a number can hold; give features and errors in a unit in which errors are nearer to 1"
        )


def _all_usable(values: FloatArray, packed: FloatArray, directions: bool) -> bool:
    """Whether all rows are certainly usable; comparisons are written so that NaN fails them."""
    d, p = values.shape[1], packed.shape[1]
    if not len(values) or (p > d and d != 2):
        return not len(values)
    if directions and not (values[:, 1].min() >= -90.0 and values[:, 1].max() <= 90.0):
        return False
    if not (values.min() > -np.inf and values.max() < np.inf and packed.max() < np.inf):
        return False
    if p <= d:
        return bool(packed.min() > 0.0)
    xx, xy, yy = packed.T
    # Twice the margin of a usable row: rows near the limit are checked one by one.
    return bool(xx.min() > 0.0 and yy.min() > 0.0 and (xx * yy * (1.0 - 2e-14) > xy * xy).all())


def _not_positive(packed: FloatArray, wrong: IntArray, d: int, source: str) -> str:
    first = int(wrong[0])
    if packed.shape[1] <= d:
        value = packed[first].min()
        return (
            f"{source}: {len(wrong)} errors are zero or negative (first: row {first}, variance {value:g}); "
            "give positive sigmas in the unit of the features, or leave the cell empty where the error is not known"
        )
    return (
        f"{source}: {len(wrong)} covariances are not positive definite (first: row {first}); "
        "check the correlations, or give sigmas in the unit of the features"
    )


def _checked_ids(ids: Sequence[Any] | NDArray[Any] | None, n: int, source: str) -> NDArray[Any]:
    if ids is None:
        return np.arange(n)
    array = np.asarray(ids)
    if array.shape != (n,):
        raise InputError(f"{source}: {array.shape} ids for {n} rows; give one id per row")
    if array.dtype.kind in "iu" and np.all(array[1:] > array[:-1]):
        return array
    ordered = np.sort(array) if array.dtype.kind in "iu" else np.sort(array.astype(str))
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(same):
        twice = ordered[same[0]]
        rows = np.flatnonzero(array.astype(ordered.dtype) == twice)
        raise InputError(
            f"{source}: {counted(len(same), 'id is', 'ids are')} not unique "
            f"(first: {twice!s} in rows {rows[0]} and {rows[1]}); give a unique id column, or none to number the rows"
        )
    return array
