"""VOTable: written as BINARY2 with cells of fixed size, which TOPCAT, astropy and the archives read.

Such files are read in bulk; others (TABLEDATA, variable-length text) by astropy, about ten times slower. Masked cells
are nulls; in files read by astropy, NaN is masked too. The provenance is in INFO elements.
"""

from __future__ import annotations

import base64
import gzip
import io
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray
from sameas.bounds import TEXT_UNPACKING, Unpacking, check_columns, unpacked
from sameas.errors import InputError, printable
from sameas.io.format import Format, ascii_of, from_text, has_huge_power, to_text, unicode_of, unit_of

if TYPE_CHECKING:
    from astropy.table import Column, Table

FORMAT = Format(
    "votable",
    "VOTable",
    (".vot", ".votable", ".xml", ".vot.gz", ".votable.gz", ".xml.gz"),
    markers=(b"<votable", b":votable"),
    unmarked=True,
)

_INFO = "sameas:"
#: Characters that XML does not allow.
_NO_XML = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f]|\xef\xbf[\xbe\xbf]")
_STREAM = re.compile(rb"<BINARY2>\s*<STREAM\s[^>]*encoding=[\"']base64[\"'][^>]*>")
_DTYPES = {
    "boolean": "S1", "unsignedByte": "u1", "short": ">i2", "int": ">i4", "long": ">i8", "float": ">f4", "double": ">f8",
    "floatComplex": ">c8", "doubleComplex": ">c16", "unicodeChar": ">u2",
}  # fmt: skip


def read(path: Path, hdu: None) -> Table:
    """The first table of a VOTable file."""
    content = _content(path)
    stream = _stream(content)
    if stream is not None:
        begin, end = stream
        document, element = _parsed(content[:begin] + content[end:], path, len(content))
        cells = _cells_dtype(element.fields)
        if cells is not None:
            table = _bulk(element, base64.b64decode(content[begin:end]), cells, path)
            return _with_meta(table, document, element, path)
    document, element = _parsed(content, path, len(content))
    table = element.to_table(use_names_over_ids=True)
    for name, column in list(table.columns.items()):
        if column.dtype.kind in "OUS" and len(column.shape) == 1:
            table.replace_column(name, _unicode(column, empty_is_missing=element.format != "binary2"))
        elif not np.any(column.mask):
            table.replace_column(name, _unmasked(column))
    return _with_meta(table, document, element, path)


def write(table: Table, path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes one table."""
    from astropy.io.votable import from_table
    from astropy.io.votable.tree import Info
    from astropy.table import Table

    columns = [_portable(table[name]) for name in table.colnames]
    for column in columns:
        if column.dtype.kind == "O" and any(np.asarray(cell).dtype.kind == "O" for cell in column if cell is not None):
            nested = f"column {column.name} has lists of records in its cells"
            raise InputError(f"{nested}; VOTable has no room for them, write .parquet or .ecsv")
        if column.dtype.kind in "US" and len(column.shape) > 1:
            raise InputError(f"column {column.name} has arrays of text; VOTable has no room for them, write .fits")
    fixed = all(column.dtype.kind != "O" for column in columns)
    packed = io.BytesIO()
    with _quiet():
        # One dummy row makes astropy write a STREAM element; the rows are inserted below.
        document = from_table(Table([_blank(column) for column in columns]) if fixed else Table(columns, copy=False))
        for field in document.get_first_table().fields:
            if fixed and field.datatype == "bit":  # shown as numbers by TOPCAT, and without nulls
                field.datatype = "boolean"
        for key, value in provenance.items():
            info = Info(name=_INFO + key, value=to_text(value))
            document.resources[0].infos.append(info)
        _params(document, table.meta)
        document.to_xml(packed, tabledata_format="binary2")
    # Cells are base64, so invalid characters can be in names and descriptions only.
    text = _NO_XML.sub(lambda found: printable(found[0].decode()).encode(), packed.getvalue())
    with gzip.open(path, "wb", compresslevel=4) if path.suffix == ".gz" else path.open("wb") as file:
        opening = _STREAM.search(text)
        if not fixed or opening is None:
            file.write(text)
            return
        file.write(text[: opening.end()] + b"\n")
        file.write(base64.b64encode(_packed(columns).tobytes()))
        file.write(b"\n" + text[text.index(b"</STREAM>", opening.end()) :])


def provenance(path: Path) -> dict[str, Any]:
    """The provenance in the INFO elements before the first table."""
    facts: dict[str, Any] = {}
    in_table = False

    def begun(name: str, attributes: Mapping[str, str]) -> None:
        nonlocal in_table
        kind = name.rpartition(":")[2]
        in_table |= kind == "TABLE"
        if kind == "INFO" and not in_table and attributes.get("name", "").startswith(_INFO):
            facts[attributes["name"].removeprefix(_INFO)] = from_text(attributes.get("value", ""))

    parser = expat.ParserCreate()
    parser.StartElementHandler = begun
    left = Unpacking().of(path.stat().st_size)
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        while not in_table and left > 0 and (part := file.read(1 << 16)):
            parser.Parse(part)
            left -= len(part)
    return facts


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses warnings about the letter of the standard, on which users of a catalogue cannot act."""
    from astropy.io.votable.exceptions import VOWarning
    from astropy.units import UnitsWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VOWarning)
        warnings.simplefilter("ignore", UnitsWarning)
        yield


def _content(path: Path) -> bytes:
    if path.suffix.lower() != ".gz":
        return path.read_bytes()
    return unpacked(path, TEXT_UNPACKING)


def parsed(content: bytes, path: Path, size: int | None = None) -> Any:
    """The parsed document; external data are refused, since astropy would load them from any URL.

    size : bytes of the whole file, if ``content`` lacks its rows.

    Raises InputError: external data; it declares far more columns or cells than it has.
    """
    from astropy.io.votable import parse

    declarations = _Declarations(path, Unpacking().of(len(content) if size is None else size))
    parser = expat.ParserCreate()
    parser.StartElementHandler = declarations.begun
    with suppress(expat.ExpatError):  # reported by astropy
        parser.Parse(content, True)
    check_columns(declarations.columns, path)
    with _quiet():
        return parse(io.BytesIO(content))


@dataclass
class _Declarations:
    """What a document declares, from its parsed XML, since entities and encodings can disguise attributes.

    astropy allocates as many rows as ``nrows`` declares, of cells as wide as ``arraysize`` declares.

    max_bytes : limit on the bytes of a table. columns : of all tables. rows, row_bytes : of the last table.
    """

    path: Path
    max_bytes: int
    columns: int = 0
    rows: int = 0
    row_bytes: int = 0

    def begun(self, name: str, attributes: Mapping[str, str]) -> None:
        """Handles the start of an element, and refuses excessive declarations."""
        if name == "TD":  # most elements are cells
            return
        kind = name.rpartition(":")[2]
        if kind == "STREAM" and "href" in attributes:
            raise InputError(f"{self.path}: its rows lie elsewhere, at {attributes['href'][:80]}; save all in one file")
        if kind == "TABLE":
            self.row_bytes, self.rows = 0, _count(attributes.get("nrows", ""))
        elif kind in ("FIELD", "PARAM"):
            self.columns += kind == "FIELD"
            self.row_bytes += _declared_bytes(attributes)
            if has_huge_power(attributes.get("unit", "")):
                unit = f"its column {attributes.get('name', '')!r} has the unit {attributes['unit']!r}"
                raise InputError(f"{self.path}: {unit}, with a power that no unit has; correct it")
        elif kind == "TR":
            self.rows += 1
        if max(self.rows, 1) * self.row_bytes > self.max_bytes:
            cells = f"its table takes more than {self.max_bytes >> 20} MB"
            raise InputError(
                f"{self.path}: {cells}, by its nrows and arraysize; correct them, or save it in another way"
            )


def _declared_bytes(attributes: Mapping[str, str]) -> int:
    """Bytes of memory of a cell of a FIELD or PARAM, with its mask."""
    text, datatype = attributes.get("arraysize", ""), attributes.get("datatype", "")
    letters = datatype in ("char", "unicodeChar")
    sizes = text.split("x")
    if sizes[-1].endswith("*"):  # variable length; for text the number is the largest length
        sizes[-1] = sizes[-1].removesuffix("*") if letters else ""
    return (4 if letters else 17 if datatype == "doubleComplex" else 9) * prod(max(_count(size), 1) for size in sizes)


def _count(text: str) -> int:
    """An integer; 0 for other text, which astropy reports."""
    try:
        return int(text)
    except ValueError:
        return 0


def _stream(content: bytes) -> tuple[int, int] | None:
    """Begin and end of the base64 text of the only table; None where the file has another layout."""
    opening = _STREAM.search(content)
    if opening is None or len(re.findall(rb"<TABLE[\s>]", content[: opening.start()])) != 1:
        return None
    end = content.find(b"<", opening.end())
    if end < 0 or content.find(b"<TABLE", end) >= 0:
        return None
    return opening.end(), end


def _parsed(content: bytes, path: Path, size: int) -> tuple[Any, Any]:
    document = parsed(content, path, size)
    for element in document.iter_tables():
        return document, element
    messages = [info.content or info.value for info in document.iter_info() if info.value == "ERROR"]
    warning = f"; it says: {messages[0].strip()}" if messages else ""
    raise InputError(f"{path}: has no table in it{warning}")


def _with_meta(table: Table, document: Any, element: Any, path: Path) -> Table:
    """The table with the metadata of the file: parameters and coordinate system."""
    for column in table.columns.values():
        if column.unit is not None:  # astropy makes a unit of its own of any word here: no angle, if it is "degrees"
            column.unit = unit_of(str(column.unit))
    for param in [*(p for resource in document.resources for p in resource.params), *element.params]:
        value = param.value.item() if isinstance(param.value, np.generic) else param.value
        if isinstance(value, str | int | float | bool):
            table.meta.setdefault(param.name, value)
    references = [field.ref for field in element.fields if field.ref]
    systems = {system.ID: system for system in document.iter_coosys()}
    used = next((systems[one] for one in references if one in systems), next(iter(systems.values()), None))
    for key in ("system", "equinox", "epoch"):
        if getattr(used, key, None) is not None:
            table.meta.setdefault(f"coosys_{key}", str(getattr(used, key)))
    count = sum(1 for _ in document.iter_tables())
    if count > 1:
        table.meta["sameas_notes"] = [f"{path} holds {count} tables; used the first"]
    return table


def _params(document: Any, meta: Mapping[str, Any]) -> None:
    """Adds PARAM elements for plain metadata values, which :func:`read` reads back."""
    from astropy.io.votable.tree import Param

    element = document.get_first_table()
    for key, value in meta.items():
        if key in ("ID", "name", "ref", "ucd", "utype") or not isinstance(value, str | bool | int | float):
            continue
        if key == "description":
            element.description = str(value)
            continue
        kinds = {str: ("unicodeChar", "*"), bool: ("boolean", None), int: ("long", None), float: ("double", None)}
        datatype, arraysize = kinds.get(type(value), ("unicodeChar", "*"))
        text = value if type(value) in kinds else str(value)
        element.params.append(Param(document, name=key, datatype=datatype, arraysize=arraysize, value=text))


def _blank(column: Column) -> Column:
    """The column with at most one, unmasked cell: older astropy cannot write masked integers."""
    from astropy.table import Column

    kept = {"name": column.name, "unit": column.unit, "description": column.description, "meta": column.meta}
    return Column(np.zeros_like(np.asarray(column[:1])), **kept)


def _portable(column: Column) -> Column:
    """The column in a type that VOTable has, without layout metadata of an earlier VOTable."""
    from astropy.table import Column, MaskedColumn

    values, mask = np.asarray(column), getattr(column, "mask", None)
    kept = {key: value for key, value in column.meta.items() if key in ("ucd", "utype", "xtype")}
    kind = values.dtype.str[1:]
    if values.dtype.kind == "O" and not any(isinstance(value, np.ndarray | list) for value in values):
        missing = np.zeros(len(values), bool) if mask is None else np.asarray(mask)
        values = np.array(["" if m or v is None else str(v) for v, m in zip(values, missing, strict=True)], dtype="U")
    elif values.dtype.kind == "O":
        lists, values = values, np.empty(len(values), dtype=object)
        for row, value in enumerate(lists):
            cell = np.ma.asarray([] if value is None else value)
            values[row] = np.ma.array(cell.data, mask=np.ma.getmaskarray(cell))
    elif kind in ("i1", "u2", "u4", "f2"):
        values = values.astype({"i1": "i2", "u2": "i4", "u4": "i8", "f2": "f4"}[kind])
    elif kind == "u8":
        # VOTable has no unsigned 64-bit type; larger numbers are written as text.
        values = values.astype("i8" if not len(values) or values.max() < 2**63 else "U20")
    if values.dtype.kind == "S":
        values = unicode_of(values)
    if values.dtype.kind == "U":
        values, kept["_votable_string_dtype"] = _text_cells(values)
    attributes = {"name": column.name, "unit": column.unit, "description": column.description, "meta": kept}
    if mask is None or not np.any(mask):
        return Column(values, **attributes)
    return MaskedColumn(values, mask=mask, **attributes)


def _text_cells(values: NDArray[Any]) -> tuple[NDArray[Any], str]:
    """The text with its width in the file, and the datatype: "char" (ASCII) or "unicodeChar" (UTF-16)."""
    cells = ascii_of(values)
    if cells is None:
        width = (np.char.encode(values, "utf-16-be").dtype.itemsize + 1) // 2
        return values.astype(f"U{width}"), "unicodeChar"
    return values.astype(f"U{cells.dtype.itemsize}", copy=False), "char"


def _packed(columns: list[Column]) -> NDArray[Any]:
    """(n,) BINARY2 rows: one null bit per column, then the cells."""
    n = len(columns[0]) if columns else 0
    cells = [_cell(column) for column in columns]
    flags = (len(columns) + 7) // 8
    kinds = [("", "u1", (flags,))] + [("", values.dtype, values.shape[1:]) for values in cells]
    rows = np.zeros(n, np.dtype(kinds))
    missing = np.zeros((n, len(columns)), bool)
    for number, (column, values) in enumerate(zip(columns, cells, strict=True)):
        rows[f"f{number + 1}"] = values
        mask = getattr(column, "mask", None)
        if mask is not None:
            missing[:, number] = _wholly_missing(column.name, np.asarray(mask), values)
    if n:
        rows["f0"] = np.packbits(missing, axis=1)
    return rows


def _wholly_missing(name: str, mask: BoolArray, values: NDArray[Any]) -> BoolArray:
    if mask.ndim == 1:
        return mask
    flat = mask.reshape(len(mask), -1)
    if values.dtype.kind not in "fc" and np.any(flat.any(axis=1) & ~flat.all(axis=1)):
        raise InputError(f"column {name} has arrays with some numbers missing; VOTable has no nulls inside arrays")
    return np.asarray(flat.all(axis=1))


def _cell(column: Column) -> NDArray[Any]:
    values, mask = np.asarray(column), getattr(column, "mask", None)
    if values.dtype.kind == "b":
        return np.where(values, b"T", b"F").astype("S1")
    if values.dtype.kind == "U":
        if column.meta["_votable_string_dtype"] == "char":
            return np.asarray(ascii_of(values))
        return np.char.encode(values, "utf-16-be").astype(f"S{values.dtype.itemsize // 2}")
    if mask is not None and values.dtype.kind in "fc":
        values = np.where(mask, np.array(np.nan, values.dtype), values)
    return values.astype(values.dtype.newbyteorder(">"), copy=False)


def _cells_dtype(fields: list[Any]) -> np.dtype[Any] | None:
    """The dtype of a BINARY2 row; None where cells have variable length."""
    kinds: list[Any] = [("", "u1", ((len(fields) + 7) // 8,))]
    for field in fields:
        sizes = str(field.arraysize).split("x") if field.arraysize else []
        if not all(size.isdigit() for size in sizes) or field.datatype not in (*_DTYPES, "char"):
            return None
        # Axes in the order of NumPy, as in astropy; the standard has the reverse order.
        shape = tuple(int(size) for size in sizes)
        if field.datatype in ("char", "unicodeChar") and len(shape) > 1:
            return None
        if field.datatype == "char":
            kinds.append(("", f"S{shape[0] if shape else 1}"))
        else:
            kinds.append(("", _DTYPES[field.datatype], () if shape == (1,) else shape))
    return np.dtype(kinds)


def _bulk(element: Any, content: bytes, kind: np.dtype[Any], path: Path) -> Table:
    from astropy.table import Column, MaskedColumn, Table

    if len(content) % kind.itemsize:
        raise InputError(f"{path}: is cut off: its rows have {kind.itemsize} bytes, the last has fewer")
    rows = np.frombuffer(content, kind)
    fields = element.fields
    missing = np.unpackbits(rows["f0"], axis=1)[:, : len(fields)].astype(bool)
    with _quiet():
        template = element.to_table(use_names_over_ids=True)
    table = Table(meta=template.meta)
    for number, (name, field) in enumerate(zip(template.colnames, fields, strict=True)):
        values, mask = _values(field, rows[f"f{number + 1}"]), missing[:, number]
        if field.values.null is not None and values.dtype.kind in "iu":
            mask = mask | (values.reshape(len(values), -1) == field.values.null).all(axis=1)
        if mask.any():
            shaped = np.broadcast_to(mask.reshape(-1, *[1] * (values.ndim - 1)), values.shape).copy()
            table.add_column(MaskedColumn(values, name=name, mask=shaped, copy=False), copy=False)
        else:
            table.add_column(Column(values, name=name, copy=False), copy=False)
        _describe(table[name], template[name])
    return table


def _values(field: Any, cells: NDArray[Any]) -> NDArray[Any]:
    if field.datatype == "boolean":
        return np.isin(cells, [b"T", b"t", b"1"])
    if field.datatype == "char":
        return unicode_of(cells)
    if field.datatype != "unicodeChar":
        return cells.astype(cells.dtype.newbyteorder("="))
    width = cells.shape[-1] if cells.ndim > 1 else 1
    text = np.ascontiguousarray(cells.astype("u4")).view(f"U{width}").reshape(cells.shape[:-1] or len(cells))
    paired = np.flatnonzero(((cells >= 0xD800) & (cells < 0xE000)).reshape(prod(text.shape), -1).any(axis=1))
    for place in paired:  # surrogate pairs: emoji, rare scripts
        text.flat[place] = text.flat[place].encode("utf-16-be", "surrogatepass").decode("utf-16-be", "replace")
    return text


def _describe(column: Column, template: Column) -> None:
    column.unit, column.description, column.format = template.unit, template.description, template.format
    column.meta.update(template.meta)


def _unicode(column: Column, empty_is_missing: bool) -> Column:
    """The column with fixed-width text instead of Python strings, unless a cell exceeds 256 characters."""
    from astropy.table import Column, MaskedColumn

    if column.dtype.kind == "O" and any(isinstance(value, np.ndarray) for value in column[:100]):
        return column
    mask = np.ma.getmaskarray(column)
    values = np.array(["" if m else v for v, m in zip(np.asarray(column).tolist(), mask, strict=True)], dtype=object)
    if max(map(len, values), default=0) <= 256:
        values = values.astype("U")
    if empty_is_missing:
        mask = mask | (values == "")
    text_column = MaskedColumn(values, mask=mask, name=column.name) if mask.any() else Column(values, name=column.name)
    _describe(text_column, column)
    return text_column


def _unmasked(column: Column) -> Column:
    from astropy.table import Column

    plain = Column(np.asarray(column), name=column.name)
    _describe(plain, column)
    return plain
