"""FITS: binary tables. Units in TUNIT, UCDs in TUCD, descriptions in TCOMM (as TOPCAT has them).

Masked cells: TNULL for integers, the byte 0 for booleans, NaN for floats, the empty string for text. FITS holds ASCII
only; other text is refused on writing.
"""

from __future__ import annotations

import gzip
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray
from sameas.bounds import Unpacking, checked_fits
from sameas.errors import InputError
from sameas.io import ldac
from sameas.io.format import Format, ascii_of, has_huge_power, to_json, to_text, unicode_of, unit_of
from sameas.representation import counted

if TYPE_CHECKING:
    from astropy.io.fits import HDUList
    from astropy.table import Column, Table


def is_ldac(path: Path, first: bytes) -> bool:
    """Whether a file called .cat is a FITS file, as SExtractor's FITS_LDAC and FITS_1.0 are."""
    return path.name.lower().endswith((".cat", ".cat.gz")) and first.startswith(b"SIMPLE  =")


FORMAT = Format(
    "fits",
    "FITS",
    (".fits", ".fit", ".fts", ".ldac", ".fits.gz", ".fit.gz", ".fts.gz", ".ldac.gz"),
    signatures=(b"SIMPLE  =",),
    several_tables=True,
    recognised=is_ldac,
)

_CARD = "SAMEAS"
_STRUCTURE = re.compile(
    r"(XTENSION|BITPIX|NAXIS\d?|PCOUNT|GCOUNT|TFIELDS|THEAP|CHECKSUM|DATASUM|SAMEAS|"
    r"T(TYPE|FORM|UNIT|NULL|SCAL|ZERO|DISP|DIM|UCD|COMM|CTYP|CUNI|CRPX|CRVL|CDLT|RPOS|BCOL)\d+)$"
)


def read(path: Path, hdu: int | str | None) -> Table:
    """The first table of a FITS file, or that of extension ``hdu``."""
    from astropy.io import fits

    checked = checked_fits(path)
    with warnings.catch_warnings():
        # Warnings about the letter of the standard do not help users of a catalogue; a truncated file is refused
        # below, with both sizes.
        warnings.filterwarnings("ignore", message="File may have been truncated")
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        with fits.open(checked, memmap=checked is path, character_as_bytes=True) as hdus:
            chips = [number for number, each in enumerate(hdus) if each.name == ldac.OBJECTS]
            if hdu is None and len(chips) > 1 and len(chips) == len(_tables(hdus)):
                tables = [_of_hdu(hdus, number, path) for number in chips]
                return ldac.stacked(tables, [ldac.image_header(hdus, number) for number in chips], path)
            number, notes = _chosen(hdus, hdu, path)
            table = _of_hdu(hdus, number, path)
    if notes:
        table.meta["sameas_notes"] = notes
    return table


def _of_hdu(hdus: HDUList, number: int, path: Path) -> Table:
    """The table in an extension; objects of FITS_LDAC with the facts of their image."""
    chosen = hdus[number]
    _check_whole(chosen, path)
    _check_arrays(chosen, path)
    # Another program's serialized columns (times, sky coordinates) are astropy's own business.
    if "--BEGIN-ASTROPY-SERIALIZED-COLUMNS--" in list(chosen.header.get("COMMENT", [])):
        return _astropys_table(chosen)
    table = _unfolded(_table(chosen))
    if chosen.name == ldac.OBJECTS:
        header = ldac.image_header(hdus, number)
        facts = {} if header is None else {key: header[key] for key in header if not _STRUCTURE.match(key)}
        table.meta = facts | table.meta
        table = ldac.with_directions(table, header)
    return table


def _tables(hdus: HDUList) -> list[int]:
    """The extensions that are tables, without the image headers of FITS_LDAC."""
    from astropy.io import fits

    kinds = (fits.BinTableHDU, fits.TableHDU)
    return [number for number, each in enumerate(hdus) if isinstance(each, kinds) and each.name != ldac.IMAGE_HEADER]


def write(table: Table, path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes one binary table."""
    from astropy.io import fits

    with warnings.catch_warnings():
        # Names such as "RA (deg)" are legal, but not recommended by the standard.
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        hdu = _hdu(table)
        if provenance:
            hdu.header[_CARD] = to_json(provenance)
            for key, value in provenance.items():
                hdu.header.add_history(_ascii(f"sameas: {key} = {to_text(value)}"))
        hdu.writeto(path, overwrite=True)
    unknown = {name: mask for name in table.colnames if (mask := _unknown(table[name])) is not None}
    if unknown:
        _write_unknown(path, [table.colnames.index(name) for name in unknown], list(unknown.values()))


def provenance(path: Path) -> dict[str, Any]:
    """The value of the card SAMEAS, from the first extension that has it."""
    from astropy.io import fits

    with fits.open(checked_fits(path), memmap=False) as hdus:
        for hdu in hdus:
            if _CARD in hdu.header:
                return dict(json.loads(hdu.header[_CARD]))
    return {}


def _hdu(table: Table) -> Any:
    from astropy.io import fits

    columns = [_fits_column(table[name]) for name in table.colnames]
    hdu = fits.BinTableHDU.from_columns(columns, character_as_bytes=True)
    for number, name in enumerate(table.colnames, start=1):
        column = table[name]
        if column.meta.get("ucd"):
            hdu.header[f"TUCD{number}"] = str(column.meta["ucd"])
        if column.description:
            hdu.header[f"TCOMM{number}"] = _ascii(str(column.description))
    _write_meta(hdu.header, table.meta)
    return hdu


def _unknown(column: Column) -> BoolArray | None:
    """Mask of unknown booleans; None where all are known."""
    mask = getattr(column, "mask", None)
    return np.asarray(mask) if column.dtype.kind == "b" and mask is not None and np.any(mask) else None


def _write_unknown(path: Path, fields: Sequence[int], masks: Sequence[BoolArray]) -> None:
    """Writes the byte 0 for unknown booleans, which astropy has written as F."""
    from astropy.io import fits

    packed = path.suffix.lower() == ".gz"
    with fits.open(path, memmap=False) as hdus:
        begin, dtype, rows = hdus[1].fileinfo()["datLoc"], hdus[1].columns.dtype, hdus[1].header["NAXIS2"]
    content = np.frombuffer(bytearray(gzip.decompress(path.read_bytes())), np.uint8) if packed else None
    whole = np.memmap(path, np.uint8, "r+") if content is None else content
    cells = np.ndarray(rows, dtype, whole, begin)
    for field, mask in zip(fields, masks, strict=True):
        cell = cells[dtype.names[field]]
        cell.view(np.uint8).reshape(mask.shape)[mask] = 0
    if isinstance(whole, np.memmap):
        whole.flush()
    else:
        path.write_bytes(gzip.compress(whole.tobytes()))


def _chosen(hdus: HDUList, hdu: int | str | None, path: Path) -> tuple[int, list[str]]:
    """The number of the extension to read, and notes."""
    from astropy.io import fits

    tables = _tables(hdus)
    if not tables:
        raise InputError(
            f"{path}: holds images only, no table",
            "`sameas frame` identifies the stars on images, `sameas movers` with --catalog what moves over them",
        )
    listed = ", ".join(f"{number} ({hdus[number].name})" if hdus[number].name else str(number) for number in tables)
    if hdu is None:
        if len(tables) == 1:
            return tables[0], []
        left_out = counted(sum(int(hdus[number].header.get("NAXIS2", 0)) for number in tables[1:]), "row")
        used = f"used {tables[0]}, without the {left_out} of the others"
        return tables[0], [f"{path} holds {len(tables)} tables, extensions {listed}; {used}"]
    number = int(hdu) if isinstance(hdu, int) or hdu.lstrip("-").isdecimal() else hdu
    try:
        chosen = hdus[number]
    except (KeyError, IndexError) as error:
        raise InputError(f"{path}: has no extension {hdu}; its tables are {listed}") from error
    if not isinstance(chosen, fits.BinTableHDU | fits.TableHDU):
        raise InputError(f"{path}: extension {hdu} is not a table; its tables are {listed}")
    return hdus.index_of(number), []


def _check_whole(hdu: Any, path: Path) -> None:
    # The data must be complete, their padding need not. gzip has a checksum of its own.
    if path.suffix.lower() == ".gz":
        return
    header = hdu.header
    end = hdu.fileinfo()["datLoc"] + header["NAXIS1"] * header["NAXIS2"] + header.get("PCOUNT", 0)
    size = path.stat().st_size
    if size < end:
        raise InputError(f"{path}: is cut off: {size} of {end} bytes are there; copy it again")


def _check_arrays(hdu: Any, path: Path) -> None:
    """Refuses variable-length arrays that take far more memory than the file: they may share the same bytes."""
    total, most = 0, Unpacking().of(path.stat().st_size)
    for number, field in enumerate(hdu.columns):
        kind = re.match(r"\d*[PQ]([A-Z])", str(field.format))
        if kind is None or not hdu.header["NAXIS2"]:
            continue
        rows = hdu.data.view(np.ndarray)
        counts = np.maximum(rows[rows.dtype.names[number]][:, 0], 0).astype(np.float64)
        # For a string of n characters astropy allocates n strings of n characters.
        total += (counts**2 if kind[1] == "A" else counts * _BYTES.get(kind[1], 1)).sum()
        if total > most:
            message = f"{path}: the arrays in column {field.name} take more than {most >> 20} MB"
            raise InputError(message, "the file is damaged, or leave this column out")


def _table(hdu: Any) -> Table:
    from astropy.table import Table

    data = hdu.data
    columns = [_column(hdu, data, number, column) for number, column in enumerate(hdu.columns, start=1)]
    return Table(columns, meta=_meta(hdu.header), copy=False)


def _astropys_table(hdu: Any) -> Table:
    from astropy.table import Column, Table

    if any(has_huge_power(str(value)) for key, value in hdu.header.items() if key.startswith("TUNIT")):
        raise InputError("a column has a unit with a power that no unit has; correct its TUNIT")
    table = Table.read(hdu, format="fits", mask_invalid=False, unit_parse_strict="silent")
    for name, column in list(table.columns.items()):
        if isinstance(column, Column) and column.dtype.kind == "S":
            values, mask = _text(np.asarray(column))
            table.replace_column(name, _made(name, values, mask))
        elif isinstance(column, Column):
            table[name] = column.astype(column.dtype.newbyteorder("="))
    table.meta = {key: value for key, value in table.meta.items() if not _STRUCTURE.match(key)}
    return table


def _column(hdu: Any, data: Any, number: int, field: Any) -> Column:
    # astropy reads an unknown boolean as False; the raw byte is 0.
    logical = field.format.endswith("L") and not field.format.startswith(("P", "Q"))
    values = data.view(np.ndarray)[data.dtype.names[number - 1]] if logical else np.asarray(data.field(number - 1))
    mask = None
    if logical:
        values = values.reshape(np.asarray(data.field(number - 1)).shape) if field.dim else values
        values, mask = values == ord("T"), values == 0
    elif values.dtype.kind == "S":
        values, mask = _text(values)
    elif values.dtype.kind != "O":
        if field.null not in (None, ""):
            # TNULL refers to the stored values, before TSCAL and TZERO.
            mask = data.view(np.ndarray)[data.dtype.names[number - 1]].reshape(values.shape) == field.null
        # A copy in native byte order: the kernels need it, and the file can be closed.
        values = values.astype(values.dtype.newbyteorder("="), copy=True)
    column = _made(field.name, values, mask)
    if field.unit:
        column.unit = unit_of(str(field.unit), "fits")
    if hdu.header.get(f"TUCD{number}"):
        column.meta["ucd"] = hdu.header[f"TUCD{number}"]
    if hdu.header.get(f"TCOMM{number}"):
        column.description = hdu.header[f"TCOMM{number}"]
    return column


def _unfolded(table: Table) -> Table:
    """The table of a single row whose cells are whole columns, as colfits of STILTS and structures of IDL have it."""
    from astropy.table import Table

    columns = list(table.columns.values())
    if len(table) != 1 or {column.shape[1:] for column in columns} not in ({(n,)} for n in columns[0].shape[1:2]):
        return table
    unfolded = [
        type(c)(c[0], name=c.name, unit=c.unit, description=c.description, meta=c.meta, copy=False) for c in columns
    ]
    return Table(unfolded, meta=table.meta, copy=False)


def _made(name: str, values: NDArray[Any], mask: BoolArray | None) -> Column:
    from astropy.table import Column, MaskedColumn

    if mask is None or not mask.any():
        return Column(values, name=name, copy=False)
    return MaskedColumn(values, name=name, mask=mask, copy=False)


def _text(values: NDArray[Any]) -> tuple[NDArray[Any], BoolArray]:
    """Unicode cells without trailing blanks, and the mask of empty ones."""
    text = np.char.rstrip(unicode_of(values), " ")
    return text, text == ""


def _meta(header: Any) -> dict[str, Any]:
    meta: dict[str, Any] = {}
    for card in header.cards:
        key = card.keyword
        if not key or _STRUCTURE.match(key):
            continue  # before card.value, which parses the card
        value = card.value
        if key in ("COMMENT", "HISTORY"):
            if not str(value).startswith("sameas: "):
                meta.setdefault("comments" if key == "COMMENT" else key, []).append(str(value))
        elif key not in meta:
            meta[key] = value
    return meta


def _write_meta(header: Any, meta: Mapping[str, Any]) -> None:
    """Writes plain metadata values as cards; others are omitted."""
    for key, value in meta.items():
        card = key.upper()
        if card in ("COMMENTS", "HISTORY") and isinstance(value, list):
            add = header.add_comment if card == "COMMENTS" else header.add_history
            for line in value:
                add(_ascii(str(line)))
        elif not re.fullmatch(r"[A-Z0-9_-]{1,8}", card) or _STRUCTURE.match(card) or card in ("COMMENT", "HISTORY"):
            continue
        elif isinstance(value, str):
            header[card] = _ascii(value)
        elif isinstance(value, bool | int | float) and np.isfinite(value):
            header[card] = value


def _ascii(text: str) -> str:
    """The text in printable ASCII, as cards require; other characters are escaped."""
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in text)


#: Bytes of one value of an array of varying length, by the code of its kind; one of the others.
_BYTES = {"I": 2, "J": 4, "K": 8, "E": 4, "D": 8, "C": 8, "M": 16}
_CODES = {"b": "L", "u1": "B", "i2": "I", "i4": "J", "i8": "K", "f4": "E", "f8": "D", "c8": "C", "c16": "M"}
_UNSIGNED = {"u2": ("I", 1 << 15), "u4": ("J", 1 << 31), "u8": ("K", 1 << 63)}


def _fits_column(column: Column) -> Any:
    from astropy.io import fits

    values, null = _stored(column)
    if values.dtype.kind == "O":
        code, values = _variable(column.name, values)
        return fits.Column(_ascii(column.name), code, array=values, unit=_unit(column))
    shape = values.shape[1:]
    sizes = tuple(reversed(shape))
    zero = None
    if values.dtype.kind == "S":
        width = max(values.dtype.itemsize, 1)
        code, sizes = f"{prod(shape) * width}A", (width, *sizes)
    else:
        spelled = "b" if values.dtype.kind == "b" else values.dtype.str[1:]
        letter, zero = _UNSIGNED[spelled] if spelled in _UNSIGNED else (_CODES[spelled], None)
        code = f"{prod(shape)}{letter}"
    return fits.Column(
        _ascii(column.name),
        code,
        array=values,
        unit=_unit(column),
        null=null if null is None or zero is None else null - zero,
        bzero=zero,
        dim=f"({','.join(map(str, sizes))})" if shape else None,
    )


def _stored(column: Column) -> tuple[NDArray[Any], int | None]:
    """The cells in a type that FITS has, with masked ones filled, and the integer that stands for null."""
    values, mask = np.asarray(column), getattr(column, "mask", None)
    mask = None if mask is None or not np.any(mask) else np.asarray(mask)
    if values.dtype.kind in "UO":
        values = _bytes(column.name, values, mask)
    if values.dtype.kind == "i" and values.dtype.itemsize == 1:
        values = values.astype("i2")
    if values.dtype == np.float16:
        values = values.astype("f4")
    if mask is None or values.dtype.kind == "O":
        return values, None
    if values.dtype.kind == "b":
        # Nulls are written as False; :func:`_write_unknown` replaces the byte.
        return values & ~mask, None
    if values.dtype.kind in "iu":
        null = _unused(values, mask)
        return np.where(mask, np.array(null, values.dtype), values), null
    return np.where(mask, np.array(b"" if values.dtype.kind == "S" else np.nan, values.dtype), values), None


def _bytes(name: str, values: NDArray[Any], mask: Any) -> NDArray[Any]:
    """Text as ASCII bytes; variable-length arrays are returned unchanged."""
    if values.dtype.kind == "O":
        if len(values) and any(isinstance(v, np.ndarray) for v in values):
            return values
        missing = np.zeros(len(values), bool) if mask is None else np.asarray(mask)
        values = np.array(["" if m or v is None else str(v) for v, m in zip(values, missing, strict=True)], dtype="U")
    cells = ascii_of(values)
    if cells is not None:
        return cells
    row = next(i for i, text in enumerate(values) if not all(t.isascii() for t in np.atleast_1d(text)))
    raise InputError(
        f"column {name!r} has letters that FITS cannot hold (row {row}: {values[row]}); "
        "write .vot, .ecsv or .parquet instead"
    )


def _variable(name: str, values: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    """The TFORM of variable-length arrays, and the arrays in a type that FITS has."""
    kinds = {np.asarray(v).dtype for v in values if v is not None}
    kind = np.result_type(*kinds) if kinds else np.dtype("f8")
    spelled = {"i1": "i2", "u2": "i4", "u4": "i8", "f2": "f4", "b1": "b"}.get(kind.str[1:], kind.str[1:])
    if kind.kind not in "biufc" or spelled not in _CODES:
        lists = f"column {name} has lists of {kind} in its cells"
        raise InputError(f"{lists}; FITS has no room for them, write .parquet or .ecsv")
    arrays = np.empty(len(values), dtype=object)
    for row, value in enumerate(values):
        arrays[row] = np.asarray([] if value is None else value, dtype="bool" if spelled == "b" else spelled)
    return f"P{_CODES[spelled]}()", arrays


def _unused(values: NDArray[Any], mask: BoolArray) -> int:
    """An integer that is in no unmasked cell: the smallest of its type, the largest, or the next one that is free."""
    limits = np.iinfo(values.dtype)
    present = values[~mask]
    for candidate in (int(limits.min), int(limits.max)) if limits.min < 0 else (int(limits.max), 0):
        if not np.any(present == candidate):
            return candidate
    taken = set(np.unique(present).tolist())
    return next(n for n in range(int(limits.min), int(limits.max) + 1) if n not in taken)


def _unit(column: Column) -> str | None:
    if column.unit is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return _ascii(column.unit.to_string("fits"))
        except ValueError:  # not a unit of the FITS standard: written as its name
            return _ascii(column.unit.to_string())
