"""One-to-one ``crossmatch`` for LSDB: ``left.crossmatch(right, algorithm=OneToOne(found), how="outer")``.

Everything is estimated once, from the catalogues on disk: ``found = sameas.match("left_hats", "right_hats")``. LSDB
then passes every partition with its margins, and the algorithm returns its pairs. Each pair is returned for the
partition of its left row, and no right row twice.

LSDB passes the left margin only for ``how="outer"``, and from version 0.11 on. Without it, rows beyond a border could
not compete and would be matched twice, so other joins, older versions and narrow margins are refused. Unlike with
``found.write(...)``, nothing is decided again with a wider halo, and records whose motion or error exceeds the margin
are not read.

Needs ``pip install sameas[lsdb]``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
from lsdb.core.crossmatch.abstract_crossmatch_algorithm import AbstractCrossmatchAlgorithm

from sameas.errors import InputError
from sameas.partitions.hats import CELL

if TYPE_CHECKING:
    from lsdb.core.crossmatch.crossmatch_args import CrossmatchArgs

    from sameas.front.partitioned import PartitionedMatch

_NUMBER = pd.ArrowDtype(pa.float64())
_COLUMNS = ("p_match", "log_odds", "sep_arcsec")


class OneToOne(AbstractCrossmatchAlgorithm):
    """One to one with probabilities; columns ``p_match``, ``log_odds`` and ``sep_arcsec``.

    Parameters
    ----------
    match : of the same two catalogues on disk, for its estimates.
    margin_arcsec : required of both catalogues; by default :attr:`halo_arcsec`. With less, some rows are wrong.

    Raises
    ------
    InputError : LSDB is older than 0.11; at ``crossmatch``: a join other than "outer", missing or too narrow margins.
    """

    extra_columns = pd.DataFrame({name: pd.Series(dtype=_NUMBER) for name in _COLUMNS})

    def __init__(self, match: PartitionedMatch, margin_arcsec: float | None = None) -> None:
        super().__init__()
        _refuse_old()
        self.work = match.estimated.work
        self.margin_arcsec = self.halo_arcsec if margin_arcsec is None else margin_arcsec
        # LSDB requires a left margin of this width, and a right one of twice this width.
        self.radius_arcsec = 0.5 * self.margin_arcsec

    @property
    def halo_arcsec(self) -> float:
        """The halo that nearly all groups of the sample need, arcsec: the smallest width of both margins."""
        return self.work.margin_arcsec

    def validate(self, left: Any, right: Any) -> None:
        """Refuse catalogues without margins of the required width."""
        super().validate(left, right)
        for side, catalogue in (("left", left), ("right", right)):
            margin = catalogue.margin
            width = 0.0 if margin is None else float(margin.hc_structure.catalog_info.margin_threshold)
            if width < self.margin_arcsec:
                has = "no margin" if margin is None else f"a margin of {width:g} arcsec"
                raise InputError(
                    f"the {side} catalogue has {has}; {self.margin_arcsec:.0f} arcsec are needed, so that what "
                    "competes beyond a border is there",
                    f"build it with hats-import, margin_threshold={np.ceil(self.margin_arcsec):.0f}, or let "
                    "sameas.match(left, right).write(path) read its own halos",
                )

    def crossmatch(
        self, crossmatch_args: CrossmatchArgs, how: str, suffixes: tuple[str, str], suffix_method: str = "all_columns"
    ) -> Any:
        """The joined rows of a partition."""
        if how != "outer":
            raise _only_outer(how)
        return super().crossmatch(crossmatch_args, how, suffixes, suffix_method)

    def crossmatch_nested(self, crossmatch_args: CrossmatchArgs, nested_column_name: str, how: str) -> Any:
        """Refused, as LSDB passes no left margin for nested joins."""
        raise _only_outer(f"{how} (nested)")

    def perform_crossmatch(self, crossmatch_args: CrossmatchArgs) -> tuple[Any, Any, pd.DataFrame]:
        """Row positions of the pairs in both frames, and their columns."""
        if crossmatch_args.left_native_len is None:
            raise _only_outer("of a version of LSDB that brings no left margin")
        one, two = (
            side.rows(_arrow(frame, side.columns(self.work.magnitudes, self.work.evidence)))
            for side, frame in zip(self.work.sides, (crossmatch_args.left_df, crossmatch_args.right_df), strict=True)
        )
        matches = self.work.identified(one, two).matches
        values = (matches.p_match, matches.log_odds, np.linalg.norm(matches.residual, axis=1))
        columns = pd.DataFrame({name: pd.Series(v, dtype=_NUMBER) for name, v in zip(_COLUMNS, values, strict=True)})
        return matches.rows_1, matches.rows_2, columns


def _arrow(frame: Any, columns: list[str]) -> pa.Table:
    table = pa.Table.from_pandas(pd.DataFrame(frame[columns]), preserve_index=False).replace_schema_metadata(None)
    return table.append_column(CELL, pa.array(np.asarray(frame.index, np.int64)))


def _only_outer(how: str) -> InputError:
    return InputError(
        f"how={how!r}: LSDB brings what competes beyond a border for how='outer' alone",
        "give how='outer', and drop the rows that are not wanted",
    )


def _refuse_old() -> None:
    from importlib.metadata import version

    major, minor = (int(part) for part in version("lsdb").split(".")[:2])
    if (major, minor) < (0, 11):
        raise InputError(f"lsdb {version('lsdb')} has no margin of the left catalogue", "pip install 'lsdb>=0.11'")


__all__ = ["OneToOne"]
