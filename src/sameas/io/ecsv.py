"""ECSV: text that keeps units, descriptions and metadata; written and read in bulk through Arrow.

A masked cell is empty; an empty text is read back as a missing one. The provenance is ``meta["sameas"]``.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Mapping
from functools import cache
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.bounds import check_columns
from sameas.errors import InputError
from sameas.io.arrow import array_of
from sameas.io.csv import content_of, may_be_cut, opened, unended, write_rows
from sameas.io.format import Format, has_huge_power

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Column, Table

_SIGNATURE = b"# %ECSV"


def is_ecsv(path: Path, first: bytes) -> bool:
    """Whether a file of any text extension is ECSV: the Gaia archive calls its files ``GaiaSource_….csv.gz``."""
    return first.startswith(_SIGNATURE)


FORMAT = Format("ecsv", "ECSV", (".ecsv", ".ecsv.gz"), signatures=(_SIGNATURE,), recognised=is_ecsv)

_KEY = "sameas"
#: Texts of cells without a value; "null" is that of the Gaia archive, whose files call themselves ECSV.
_NULLS = ["", "null"]
#: Bytes at the beginning of a file in which the names of columns are looked for.
_HEAD_BYTES = 1 << 22


def read(path: Path, hdu: None) -> Table:
    """The table of an ECSV file."""
    from astropy.table import Table

    content = content_of(path)
    head = bytes(memoryview(content)[:_HEAD_BYTES]).partition(b"\n# meta:")[0]
    check_columns(len(re.findall(rb"^# - ", head, re.MULTILINE)), path)
    if any(has_huge_power(unit.decode("utf-8", "replace")) for unit in re.findall(rb"\bunit: *([^,}\n]*)", head)):
        raise InputError(f"{path}: a column has a unit with a power that no unit has; correct its header")
    table = _bulk_read(path)
    if table is None:
        table = Table.read(path, format="ascii.ecsv", fill_values=[(text, "0") for text in _NULLS])
    table.meta.pop(_KEY, None)
    if unended(content):
        table.meta["sameas_notes"] = [may_be_cut(path)]
    return table


def write(table: Table, path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes an ECSV file with commas."""
    from astropy.table import Table

    meta = {key: _spelled_out(value) for key, value in table.meta.items() if key not in ("sameas_notes", _KEY)}
    if provenance:
        meta[_KEY] = _spelled_out(dict(provenance))
    whole = Table(list(table.columns.values()), names=table.colnames, meta=meta, copy=False)
    columns = list(whole.columns.values())
    for column in columns:
        column.description = _spelled_out(column.description)
    text = StringIO()
    if any(len(column.shape) > 1 or column.dtype.kind not in "biufSU" for column in columns):
        # Cells with several values are JSON: astropy's own writer, slower, knows how.
        whole.write(text, format="ascii.ecsv", delimiter=",")
        with opened(path) as file:
            file.write(text.getvalue().encode("utf-8"))
        return
    whole[:0].write(text, format="ascii.ecsv", delimiter=",")
    comments = [line + "\n" for line in text.getvalue().splitlines() if line.startswith("#")]
    with opened(path) as file:
        file.write("".join(comments).encode("utf-8"))
        write_rows(whole.colnames, [_spelled(column) for column in columns], file, ",")


def provenance(path: Path) -> dict[str, Any]:
    """What ``meta["sameas"]`` in the header says."""
    from astropy.table.meta import get_header_from_yaml

    header = []
    with gzip.open(path, "rt", encoding="utf-8") if path.suffix == ".gz" else path.open(encoding="utf-8") as file:
        for line in file:
            if not line.startswith("#"):
                break
            header.append(line[2:].rstrip("\n"))
    return dict((get_header_from_yaml(header).get("meta") or {}).get(_KEY, {}))


def _bulk_read(path: Path) -> Table | None:
    """The table by astropy's Arrow engine; None where this astropy has none, or it cannot read the file."""
    try:
        from astropy.io.misc.ecsv import read_ecsv
    except ImportError:  # astropy before 7.2
        return None
    from astropy.io.ascii import InconsistentTableError

    try:
        return read_ecsv(path, engine="pyarrow", null_values=_NULLS)
    except TypeError:  # float128
        return None
    except InconsistentTableError as error:
        if "yaml" in str(error):  # its header has an empty line, as astropy writes texts of several lines
            return None
        raise


class _Lines(str):
    """A text of several lines, which YAML has in one: an empty line within ends the header for some readers."""


@cache
def _known_to_yaml() -> None:
    from astropy.io.misc.yaml import AstropyDumper

    tag = "tag:yaml.org,2002:str"
    AstropyDumper.add_representer(_Lines, lambda dumper, text: dumper.represent_scalar(tag, str(text), style='"'))


def _spelled_out(value: Any) -> Any:
    """The same metadata, texts of several lines as ``_Lines``."""
    if isinstance(value, str) and "\n" in value:
        _known_to_yaml()
        return _Lines(value)
    if isinstance(value, dict):
        return type(value)((_spelled_out(key), _spelled_out(inner)) for key, inner in value.items())
    return [_spelled_out(inner) for inner in value] if type(value) is list else value


def _spelled(column: Column) -> pa.Array:
    """The cells as ECSV spells them: truth values are True and False."""
    import pyarrow as pa
    from pyarrow import compute

    array = array_of(column)
    if pa.types.is_boolean(array.type):
        return compute.if_else(array, "True", "False")
    return array.cast(pa.float32()) if pa.types.is_float16(array.type) else array
