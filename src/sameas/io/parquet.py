"""Parquet: fast, exact, small. Units in the metadata of each column and in the form that astropy reads.

A masked cell is a null. The UCDs and units of VOParquet files are read too.
"""

from __future__ import annotations

import json
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.bounds import check_columns, check_rows
from sameas.errors import InputError
from sameas.io.arrow import array_of, column_of
from sameas.io.format import Format, unit_of
from sameas.io.votable import parsed
from sameas.kernels import threads

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Column, Table

FORMAT = Format("parquet", "Parquet", (".parquet", ".pq", ".parq"), signatures=(b"PAR1",), in_pieces=True)

_KEY = b"sameas"
_ASTROPY = b"table_meta_yaml"
_VOPARQUET = b"IVOA.VOTable-Parquet.content"
#: The key under which pandas looks for its types.
PANDAS = b"pandas"


#: Files that are decoded already, each with a function that waits for the content.
_begun: dict[Path, Callable[[], pa.Table]] = {}


def read_ahead(path: Path) -> None:
    """Decode a file in a thread, for the next :func:`read` of it; errors are raised there."""
    import pyarrow.parquet  # noqa: F401 (imported here, by one thread)

    _begun[path] = threads.started(partial(_content, path))


def _content(path: Path) -> pa.Table:
    from pyarrow import parquet

    with parquet.ParquetFile(path, memory_map=True, pre_buffer=False) as file:
        check_columns(len(file.schema_arrow), path)
        check_rows(file.metadata.num_rows, path)
        return file.read()


def read(path: Path, hdu: None) -> Table:
    """The table of a Parquet file."""
    from astropy.table import Table

    content = _begun.pop(path, partial(_content, path))()
    columns, left_out = [], []
    for name in content.column_names:
        if content.column_names.count(name) > 1:
            raise InputError(f"{path}: two columns are called {name}; rename one")
        column = column_of(name, content.column(name))
        if column is None:
            left_out.append(
                f"{path}: column {name} ({content.schema.field(name).type}) is no column of cells; left out"
            )
            continue
        described(column, decoded(content.schema.field(name).metadata))
        columns.append(column)
    table = _with_file_metadata(Table(columns, copy=False), content.schema.metadata or {}, path)
    del content  # what was read is NumPy's now
    release_unused()
    if left_out:
        table.meta["sameas_notes"] = left_out
    return table


def release_unused() -> None:
    """Return the memory of what was read to the system; Arrow would keep it for what it might read next.

    Call it in the main thread, too, after several files were read in others: what these freed of one another's memory
    is returned only then (a tenth of the peak of a match).
    """
    import pyarrow as pa

    pa.default_memory_pool().release_unused()


def write(table: Table, path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes a Parquet file (snappy: numbers of a catalogue hardly shrink, and it costs nothing)."""
    write_pieces(iter([table]), path, provenance)


def write_pieces(tables: Iterator[Table], path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes tables with the same columns as row groups of one file; one is encoded while the next is computed."""
    import pyarrow as pa
    from pyarrow import parquet

    first = next(tables)
    arrays = _arrays(first)
    fields = [
        pa.field(name, array.type, metadata=column_metadata(first[name]))
        for name, array in zip(first.colnames, arrays, strict=True)
    ]
    schema = pa.schema(fields, metadata=_file_metadata(first, provenance))
    del first
    # A dictionary pays for names that come again; numbers of a catalogue do not.
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    options: dict[str, Any] = {"compression": "snappy", "use_dictionary": texts or False}
    with parquet.ParquetWriter(path, schema, **options) as writer, ThreadPoolExecutor(1) as encoder:
        while arrays:
            encoded = encoder.submit(writer.write_table, pa.Table.from_arrays(arrays, schema=schema))
            arrays = _arrays(next(tables, None))
            encoded.result()


def _arrays(table: Table | None) -> list[pa.Array]:
    """The columns as Arrow arrays; none without a table."""
    return [] if table is None else [array_of(table[name]) for name in table.colnames]


def provenance(path: Path) -> dict[str, Any]:
    """What the key ``sameas`` of the schema says."""
    from pyarrow import parquet

    metadata = parquet.read_schema(path).metadata or {}
    return dict(json.loads(metadata.get(_KEY, b"{}")))


def decoded(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    """Metadata of a field of Arrow as text."""
    return {key.decode("utf-8", "replace"): value.decode("utf-8", "replace") for key, value in (metadata or {}).items()}


def described(column: Column, facts: Mapping[str, Any]) -> None:
    """Gives a column its unit, description and UCD from a field's metadata."""
    if facts.get("unit"):
        column.unit = unit_of(str(facts["unit"]))
    if facts.get("description"):
        column.description = str(facts["description"])
    if facts.get("ucd"):
        column.meta["ucd"] = str(facts["ucd"])


def _with_file_metadata(table: Table, metadata: Mapping[bytes, bytes], path: Path) -> Table:
    if _ASTROPY in metadata:
        return _with_astropys(table, metadata[_ASTROPY].decode("utf-8"))
    if _VOPARQUET in metadata:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fields = parsed(metadata[_VOPARQUET], path).get_first_table().fields
        for field in fields:
            if field.name in table.colnames:
                described(table[field.name], {k: getattr(field, k) for k in ("unit", "description", "ucd")})
    return table


def _with_astropys(table: Table, text: str) -> Table:
    from astropy.table import serialize

    header = described_by(text)
    for facts in header["datatype"]:
        if facts["name"] in table.colnames:
            column = table[facts["name"]]
            described(column, facts)
            column.format = facts.get("format", column.format)
            column.meta.update(facts.get("meta", {}))
    table.meta.update(header.get("meta", {}))
    if "__serialized_columns__" in table.meta:
        # Masks and sky coordinates that astropy's own writer takes apart.
        table = serialize._construct_mixins_from_columns(table)
    return table


def described_by(text: str) -> dict[str, Any]:
    """What astropy's YAML says of a table; plain values without the imports that ``header_of`` avoids."""
    import yaml
    from astropy.table import meta

    class Plain(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
        """Raises for what is not plain."""

    def of_ordered(loader: Plain, node: yaml.SequenceNode) -> dict[Any, Any]:
        pairs = [pair for mapping in node.value for pair in mapping.value]
        return {loader.construct_object(k, deep=True): loader.construct_object(v, deep=True) for k, v in pairs}

    Plain.add_constructor("tag:yaml.org,2002:omap", of_ordered)
    try:
        return dict(Plain(text).get_single_data())
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return dict(meta.get_header_from_yaml(text.split("\n")))


def column_metadata(column: Column) -> dict[str, str] | None:
    """Unit, description and UCD of a column, for a field of Arrow."""
    facts = {
        "unit": column.unit.to_string() if column.unit is not None else None,
        "description": column.description,
        "ucd": column.meta.get("ucd"),
    }
    return {key: str(value) for key, value in facts.items() if value} or None


def header_of(table: Table) -> list[str]:
    """The lines of YAML with which astropy's readers describe a table, as :mod:`astropy.table.meta` writes them.

    What astropy writes them with knows times and coordinates too, and imports all of both for that: a tenth of a short
    run. Plain values, as nearly all tables have, do without.
    """
    import yaml
    from astropy.table import meta

    try:
        parts = meta.ColumnDict, meta._get_col_attributes, meta._repr_odict
    except AttributeError:  # another astropy
        return list(meta.get_yaml_from_table(table))
    ordered, attributes, of_ordered = parts

    class Plain(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
        """Raises for what is not plain."""

    def of_column(dumper: Plain, column: Mapping[str, Any]) -> yaml.MappingNode:
        pairs: Any = column.items()
        pairs.sort()  # in the order that is astropy's for columns
        return dumper.represent_mapping("tag:yaml.org,2002:map", pairs)

    Plain.add_representer(ordered, of_column)
    Plain.add_representer(OrderedDict, of_ordered)
    Plain.add_representer(tuple, Plain.represent_undefined)
    header: dict[str, Any] = {"datatype": [attributes(column) for column in table.columns.values()]}
    if table.meta:
        header["meta"] = OrderedDict(table.meta)
    try:
        text: str = yaml.dump(header, default_flow_style=None, Dumper=Plain, width=130)
    except yaml.representer.RepresenterError:
        return list(meta.get_yaml_from_table(table))
    return text.splitlines()


def _file_metadata(table: Table, provenance: Mapping[str, Any]) -> dict[bytes, bytes]:
    from astropy.table import MaskedColumn, Table

    kept = {key: value for key, value in table.meta.items() if key != "sameas_notes"}
    bare = Table(list(table[:0].columns.values()), names=table.colnames, meta=kept)
    metadata = {_ASTROPY: "\n".join(header_of(bare)).encode()}
    for name in table.colnames:
        kind = table[name].dtype
        if kind.kind in "US":
            # astropy's reader wants the width of text columns here, or looks for it and warns.
            width = kind.itemsize // (4 if kind.kind == "U" else 1)
            metadata[f"table::len::{name}".encode()] = str(max(width, 1)).encode()
    masked = (column for column in table.columns.values() if isinstance(column, MaskedColumn))
    metadata[PANDAS] = json.dumps(pandas_types(masked)).encode()
    if provenance:
        metadata[_KEY] = json.dumps(provenance).encode()
    return metadata


def pandas_types(columns: Iterable[Column]) -> dict[str, Any]:
    """Tells pandas which columns of whole numbers and truth values may have nulls: all of these.

    Without this ``pandas.read_parquet`` makes floats of whole numbers with a null, which rounds long identifiers, and
    objects of truth values.
    """
    said = []
    for column in columns:
        name, kind = column.info.name, column.dtype
        if column.ndim > 1 or kind.kind not in "biu":
            continue
        plain = "boolean" if kind.kind == "b" else kind.name.replace("uint", "UInt").replace("int", "Int")
        said.append(
            {
                "name": name,
                "field_name": name,
                "pandas_type": "bool" if kind.kind == "b" else kind.name,
                "numpy_type": plain,
                "metadata": None,
            }
        )
    return {"index_columns": [], "column_indexes": [], "columns": said}
