"""The rows of a picture's tables, gathered over its instants.

The columns of one instant are small, and lie in memory between what the instant needed for its decisions and released.
Held one by one they would keep three times their size. They are packed together after some instants; texts, which NumPy
stores as four bytes for each letter of the longest, as UTF-8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: One row per object or record. Numbers are arrays, masked where absent; texts are arrays of str, "" for none.
#: Latitudes and longitudes are included if the picture has a plane on the earth.
Columns = dict[str, NDArray[Any]]
#: Instants that are packed together.
PACKED = 16


@dataclass
class GatheredRows:
    """Rows of successive instants. Add those of each with :meth:`add`, and take all at the end with :meth:`taken`.

    >>> rows = GatheredRows()
    >>> for name in ("north", "south"):
    ...     rows.add({"source": np.array([name]), "row": np.array([7])})
    >>> rows.taken()
    {'source': array(['north', 'south'], dtype='<U5'), 'row': array([7, 7])}
    """

    _recent: list[Columns] = field(default_factory=list)
    _packed: list[dict[str, Any]] = field(default_factory=list)

    def add(self, columns: Columns) -> None:
        """Add the rows of an instant; all instants have the same columns."""
        self._recent.append(columns)
        if len(self._recent) == PACKED:
            self._pack()

    def taken(self) -> Columns:
        """All rows, which are then no longer held here."""
        self._pack()
        names = list(self._packed[0]) if self._packed else []
        return {name: _unpacked([part.pop(name) for part in self._packed]) for name in names}

    def _pack(self) -> None:
        import pyarrow as pa

        if self._recent:
            columns = gathered(self._recent)
            self._recent.clear()
            self._packed.append(
                {name: pa.array(column) if column.dtype.kind == "U" else column for name, column in columns.items()}
            )


def gathered(parts: Sequence[Mapping[str, NDArray[Any]]]) -> Columns:
    """The rows of several instants, concatenated."""
    if not parts:
        return {}
    return {name: _concatenated([part[name] for part in parts]) for name in parts[0]}


def _concatenated(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenated columns, a masked array if any of them is."""
    if any(isinstance(column, np.ma.MaskedArray) for column in columns):
        return np.asanyarray(np.ma.concatenate(columns))  # type: ignore[no-untyped-call]
    return np.concatenate(columns)


def _unpacked(parts: Sequence[Any]) -> NDArray[Any]:
    """A column of its packed parts."""
    if isinstance(parts[0], np.ndarray):
        return _concatenated(parts)
    import pyarrow as pa

    return np.asarray(pa.chunked_array(parts).to_numpy().astype(np.str_))
