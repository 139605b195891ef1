"""Rows: frozen columns of equal length, of which what stands at one place belongs together."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray


class Rows:
    """Base of dataclasses whose fields are columns (k, …), but for those named in ``WHOLE``, which no row has alone."""

    WHOLE: ClassVar[frozenset[str]] = frozenset()

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by their names."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in self.WHOLE}  # type: ignore[arg-type]

    def take(self, which: NDArray[Any]) -> Self:
        """Some of the rows: places, in any order, or a mask."""
        return replace(self, **{name: column[which] for name, column in self.columns().items()})  # type: ignore[type-var]

    def stacked(self, *others: Self) -> Self:
        """These rows and those of others below them; what is of all rows stays that of these."""
        parts = [part.columns() for part in (self, *others)]
        return replace(self, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})  # type: ignore[type-var]
