"""Conversion between Arrow and astropy columns: nulls become masks, integers stay integers, text is Unicode.

Numbers, and the text of small tables, are converted through Arrow's buffers: Arrow's own conversions import pandas, if
installed, and ``pyarrow.compute``, which takes longer than reading a small table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, IntArray
from sameas.errors import InputError
from sameas.io.format import ascii_of, unicode_of

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Column

_WIDEST_FIXED_TEXT = 256
#: Above this number of rows ``pyarrow.compute`` is faster for text, including its import.
FEW_ROWS = 50_000
_FLOATS = {"halffloat": "float16", "float": "float32", "double": "float64"}


def column_of(name: str, values: pa.ChunkedArray) -> Column | None:
    """The astropy column of an Arrow column; None for structs and maps, which a cell cannot hold."""
    from astropy.table import Column, MaskedColumn

    array, mask = _numpy_of(_simple(values))
    if array is None:
        return None
    if mask is None or not mask.any():
        return Column(array, name=name, copy=False)
    return MaskedColumn(array, name=name, mask=mask, copy=False)


def array_of(column: Column) -> pa.Array:
    """The Arrow array of an astropy column; fixed-size lists where the column has several dimensions.

    Raises InputError: cells of a type that Arrow does not have, or of several types.
    """
    import pyarrow as pa

    values, mask = np.asarray(column), getattr(column, "mask", None)
    mask = None if mask is None or not np.any(mask) else np.ascontiguousarray(np.broadcast_to(mask, values.shape))
    flat, flat_mask = values.reshape(-1), None if mask is None else mask.reshape(-1)
    if flat.dtype.kind == "S":
        flat = unicode_of(flat)
    if flat.dtype.kind == "O" and any(isinstance(value, np.ma.MaskedArray) for value in flat):
        flat = np.fromiter((np.ma.asarray(value).tolist() for value in flat), dtype=object, count=len(flat))
    if flat.dtype.kind not in "OU":
        flat = np.ascontiguousarray(flat.astype(flat.dtype.newbyteorder("="), copy=False))
    try:
        if flat.dtype.kind in "biuf" and flat.dtype.itemsize <= 8:
            array = _numbers(flat, flat_mask)
        else:
            array = _texts(flat, flat_mask) if flat.dtype.kind == "U" else pa.array(flat, mask=flat_mask)
    except (pa.ArrowException, TypeError) as error:
        raise InputError(f"column {column.name} holds {_kinds(flat)}; give numbers, truth values or text") from error
    for size in reversed(values.shape[1:]):
        array = pa.FixedSizeListArray.from_arrays(array, int(size))
    return array


def _numbers(values: NDArray[Any], mask: BoolArray | None) -> pa.Array:
    """An Arrow array of numbers or booleans that shares the memory of the NumPy array."""
    import pyarrow as pa

    data = np.packbits(values, bitorder="little") if values.dtype.kind == "b" else values
    buffers = [None if mask is None else _bits(~mask), pa.py_buffer(data)]
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), buffers)


def _bits(valid: BoolArray) -> pa.Buffer:
    """The validity bitmap of Arrow: one bit per cell."""
    import pyarrow as pa

    return pa.py_buffer(np.packbits(valid, bitorder="little"))


def _texts(values: NDArray[Any], mask: BoolArray | None) -> pa.Array:
    """Unicode cells as an Arrow string array: one buffer of characters, and the offset of each cell."""
    import pyarrow as pa

    cells = ascii_of(values)
    if cells is None or cells.nbytes >= 2**31:
        return pa.array(values, mask=mask)
    letters = cells.view(np.uint8).reshape(len(cells), cells.dtype.itemsize)
    used = letters != 0
    if mask is not None:
        used &= ~mask[:, None]
    begins = np.zeros(len(cells) + 1, np.int32)
    np.cumsum(used.sum(axis=1), out=begins[1:])
    valid = None if mask is None else _bits(~mask)
    buffers = [valid, pa.py_buffer(begins), pa.py_buffer(letters[used])]
    return pa.Array.from_buffers(pa.string(), len(cells), buffers)


def _kinds(values: NDArray[Any]) -> str:
    if values.dtype.kind != "O":
        return f"values of type {values.dtype}"
    return " and ".join(sorted({type(value).__name__ for value in values[:1000]}))


def _simple(values: pa.ChunkedArray) -> pa.ChunkedArray:
    """The column in a supported type: dates as ISO text, decimals as floats, dictionaries as values."""
    import pyarrow as pa

    kind = values.type
    if pa.types.is_dictionary(kind):
        if str(kind.value_type) == "string_view":  # from polars; Arrow cannot cast it
            words = [(chunk.indices, chunk.dictionary.cast(pa.large_string())) for chunk in values.chunks]
            plain = pa.dictionary(kind.index_type, pa.large_string())
            chunks = [pa.DictionaryArray.from_arrays(number, word) for number, word in words]
            return pa.chunked_array(chunks, plain).cast(pa.large_string())
        return _simple(values.cast(kind.value_type))
    if pa.types.is_timestamp(kind):
        text = values.cast(pa.timestamp(kind.unit)).cast(pa.string())
        return pa.compute.replace_substring(text, " ", "T")
    if pa.types.is_temporal(kind):
        return values.cast(pa.int64() if pa.types.is_duration(kind) else pa.string())
    if pa.types.is_decimal(kind) or pa.types.is_null(kind):
        return values.cast(pa.float64())
    if pa.types.is_large_string(kind) or pa.types.is_string(kind):
        return values
    if str(kind) in ("string_view", "binary", "large_binary", "binary_view"):
        return values.cast(pa.large_string())
    return values


def _numpy_of(values: pa.ChunkedArray) -> tuple[NDArray[Any] | None, BoolArray | None]:
    import pyarrow as pa

    kind = values.type
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _text(values), _missing(values)
    if pa.types.is_fixed_size_list(kind):
        return _cells(values)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return values.to_numpy(), _missing(values)
    if not (pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return None, None
    mask = _missing(values)
    # Arrow would convert integers with nulls to floats, which changes long identifiers.
    array = np.concatenate([np.empty(0, _dtype(kind)), *(numbers_in(chunk) for chunk in values.chunks)])
    if mask is not None:
        array[mask] = 0
    return array, mask


def _dtype(kind: pa.DataType) -> np.dtype[Any]:
    return np.dtype(_FLOATS.get(str(kind), str(kind)))


def numbers_in(chunk: pa.Array) -> NDArray[Any]:
    """The numbers or booleans of an Arrow array, sharing its memory if possible; null cells have arbitrary values.

    >>> import pyarrow as pa
    >>> numbers_in(pa.array([1.5, 2.5, 3.5])[1:])
    array([2.5, 3.5])
    """
    kind = _dtype(chunk.type)
    if not len(chunk):
        return np.empty(0, kind)
    data = chunk.buffers()[1]
    if kind.kind == "b":
        return _bits_in(data, chunk)
    return np.frombuffer(data, kind, len(chunk), chunk.offset * kind.itemsize)


def _bits_in(buffer: pa.Buffer, chunk: pa.Array) -> BoolArray:
    """(n,) the bits of a buffer for the cells of an array."""
    octets = np.frombuffer(buffer, np.uint8)[chunk.offset // 8 : (chunk.offset + len(chunk) + 7) // 8]
    begin = chunk.offset % 8
    return np.unpackbits(octets, bitorder="little")[begin : begin + len(chunk)].view(np.bool_)


def _missing(values: pa.ChunkedArray) -> BoolArray | None:
    if not values.null_count:
        return None
    if str(values.type) == "null":
        return np.ones(len(values), np.bool_)
    return np.concatenate(
        [
            ~_bits_in(chunk.buffers()[0], chunk) if chunk.null_count else np.zeros(len(chunk), np.bool_)
            for chunk in values.chunks
        ]
    )


def _cells(values: pa.ChunkedArray) -> tuple[NDArray[Any] | None, BoolArray | None]:
    """(n, size, …) from lists of one size."""
    import pyarrow as pa

    size = values.type.list_size
    if values.null_count:
        # flatten() omits the cells of null lists.
        empty = pa.array([[None] * size], values.type)
        values = pa.chunked_array(
            [pa.concat_arrays([chunk, empty]).take(_or_last(chunk)) for chunk in values.chunks], values.type
        )
    inner = pa.chunked_array([chunk.flatten() for chunk in values.chunks], values.type.value_type)
    flat, mask = _numpy_of(_simple(inner))
    if flat is None:
        return None, None
    shape = (len(values), size, *flat.shape[1:])
    return flat.reshape(shape), None if mask is None else mask.reshape(shape)


def _or_last(chunk: pa.Array) -> IntArray:
    """The row numbers of a chunk, with null rows replaced by the number of rows."""
    return np.where(chunk.is_null().to_numpy(zero_copy_only=False), len(chunk), np.arange(len(chunk)))


def _text(values: pa.ChunkedArray) -> NDArray[Any]:
    """Fixed-width Unicode, which sorts fast; Python strings where the longest exceeds 256 characters."""
    if len(values) <= FEW_ROWS:
        text = np.array([cell or "" for chunk in values.chunks for cell in chunk.to_pylist()], dtype=object)
        if max(map(len, text), default=0) > _WIDEST_FIXED_TEXT:
            return text
        return text.astype(np.str_) if len(text) else np.empty(0, "U1")
    from pyarrow import compute

    values = compute.fill_null(values, "")
    width = max(compute.max(compute.utf8_length(values)).as_py() or 1, 1)
    if width > _WIDEST_FIXED_TEXT:
        return np.asarray(values.to_numpy())
    text = np.empty(len(values), dtype=f"U{width}")
    begin = 0
    for chunk in values.chunks:
        end = begin + len(chunk)
        if compute.all(compute.string_is_ascii(chunk)).as_py():
            # Padded to equal length, the characters of a chunk are the buffer of a NumPy array.
            padded = compute.ascii_rpad(chunk, width, padding="\0") if len(chunk) else chunk
            if len(chunk):
                offset = int(np.frombuffer(padded.buffers()[1], _offsets(padded), padded.offset + 1)[padded.offset])
                cells = np.frombuffer(padded.buffers()[2], f"S{width}", len(chunk), offset)
                text[begin:end] = unicode_of(cells)
        else:
            text[begin:end] = chunk.to_numpy(zero_copy_only=False)
        begin = end
    return text


def _offsets(array: pa.Array) -> type:
    import pyarrow as pa

    return np.int64 if pa.types.is_large_string(array.type) else np.int32
