"""The joined table of several catalogues: :func:`joined_many`.

There is one row per object, in the order of the first catalogue, then of the second for objects
that are not in the first, and so on. Added columns:

n_catalogues : number of catalogues with the object. p_object : probability of exactly these records. runner_up : the
records of the most probable alternative for one of them, "catalogue id = …", masked below a probability of 0.001, and
p_runner_up its probability. ra_object, dec_object, pmra_object, pmdec_object : position at ``epoch_object`` and proper
motion from all its records, with ``…_error`` and ``ra_dec_object_corr`` by the scatter of the residuals; the motion is
masked where the records do not determine it. chi_sq : of its records, 2 (n_catalogues − 1) degrees of freedom, by the
quoted errors. group_id, group_size : the group of competing records.
"""

from __future__ import annotations

import unicodedata
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Column, MaskedColumn, Table
from numpy.typing import NDArray

from sameas.arrays import ABSENT, IntArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.sky.joins import joined_names, taken_rows
from sameas.sky.output_columns import attributes_of, free_name

if TYPE_CHECKING:
    from sameas.sky.many import ManyMatch


#: Minimum probability of a runner-up that is listed (chosen).
MIN_RUNNER_UP = 1e-3


def joined_many(match: ManyMatch, *, least: int = 1) -> Table:
    """One row per object in at least ``least`` catalogues; with 1 also the unusable rows.

    Raises InputError: ``least`` is not between 1 and the number of catalogues.
    """
    if not 1 <= least <= len(match.catalogues):
        raise InputError(
            f"least is {least}; give 1 to {len(match.catalogues)}, in how many catalogues an object must be"
        )
    members = np.ma.filled(match.objects.members, ABSENT)
    number = np.flatnonzero(match.objects.n_members >= least)
    rows = members[number]
    if least == 1:
        unused = _unused(match)
        rows, number = np.concatenate([rows, unused]), np.concatenate([number, np.full(len(unused), ABSENT)])
    order = np.lexsort(np.where(rows == ABSENT, np.iinfo(np.int64).max, rows).T[::-1])
    rows, number = rows[order], number[order]
    table = Table()
    tables = [catalogue.table for catalogue in match.catalogues]
    for names, source, at in zip(joined_names(tables), tables, rows.T, strict=True):
        for name, column in zip(names, source.columns.values(), strict=True):
            taken_cells = taken_rows(column, at)
            table[name] = MaskedColumn(taken_cells) if isinstance(taken_cells, Column) else taken_cells
    missing = number == ABSENT
    for name, values in _object_columns(match, np.where(missing, 0, number)).items():
        unique = free_name(name, table.colnames)
        mask = np.ma.getmaskarray(values) | missing
        table[unique] = MaskedColumn(np.ma.getdata(values), mask=mask, **attributes_of(name))
    return table


def _unused(match: ManyMatch) -> IntArray:
    """(k, S) the rows that were set aside, one per set."""
    parts = []
    for k, records in enumerate(match.objects.given):
        assert isinstance(records, Records)
        unusable = records.set_aside.rows
        rows = np.full((len(unusable), len(match.catalogues)), ABSENT)
        rows[:, k] = unusable
        parts.append(rows)
    return np.concatenate(parts)


def _object_columns(match: ManyMatch, at: IntArray) -> dict[str, NDArray[Any] | np.ma.MaskedArray]:
    """The added columns, for some of the objects."""
    objects, state = match.objects, match.state
    sigma = np.sqrt(np.diagonal(state.covariance, axis1=1, axis2=2))[at]
    position_mas, motion_mas = 1e3 * sigma[:, :2], 1e3 * sigma[:, 2:]
    values: dict[str, NDArray[Any] | np.ma.MaskedArray] = {
        "n_catalogues": objects.n_members[at].astype(np.int16),
        "p_object": objects.probability[at],
        "p_runner_up": objects.p_runner_up[at],
        "runner_up": _runner_up_texts(match, at),
        "ra_object": state.state[at, 0],
        "dec_object": state.state[at, 1],
        "ra_object_error": position_mas[:, 0],
        "dec_object_error": position_mas[:, 1],
        "ra_dec_object_corr": 1e6 * state.covariance[at, 0, 1] / (position_mas[:, 0] * position_mas[:, 1]),
    }
    if match.epoch_jyr is not None:
        no_motion = ~match.has_motion[at]
        for k, name in enumerate(("pmra_object", "pmdec_object")):
            values[name] = np.ma.MaskedArray(1e3 * state.state[at, 2 + k], no_motion)
            values[f"{name}_error"] = np.ma.MaskedArray(motion_mas[:, k], no_motion)
        values["epoch_object"] = np.full(len(at), match.epoch_jyr)
    group = objects.group[at]
    return values | {
        "chi_sq": np.ma.MaskedArray(state.chi_sq[at], objects.n_members[at] == 1),
        "group_id": group,
        "group_size": objects.groups.records[group],
    }


def _runner_up_texts(match: ManyMatch, at: IntArray) -> np.ma.MaskedArray:
    """(k,) runners-up as "catalogue id = catalogue id", masked below :data:`MIN_RUNNER_UP`."""
    rows = np.ma.filled(match.objects.runner_up, ABSENT)[at]
    listed = np.flatnonzero(np.ma.filled(match.objects.p_runner_up, 0.0)[at] >= MIN_RUNNER_UP)
    names = [_to_ascii(catalogue.name) for catalogue in match.catalogues]
    texts = [
        " = ".join(
            f"{name} {catalogue.ids[row]}"
            for name, catalogue, row in zip(names, match.catalogues, rows[k].tolist(), strict=True)
            if row != ABSENT
        )
        for k in listed.tolist()
    ]
    out = np.zeros(len(at), f"U{max(map(len, texts), default=1)}")
    out[listed] = texts
    mask = np.ones(len(at), bool)
    mask[listed] = False
    return np.ma.MaskedArray(out, mask)


def _to_ascii(name: str) -> str:
    """A catalogue name in ASCII without accents, as FITS requires."""
    return unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode() or "catalogue"
