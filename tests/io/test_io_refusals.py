"""Unreadable and unwritable files are refused in one sentence that names the file."""

import gzip
import urllib.request
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from pyarrow import parquet

from sameas.errors import InputError
from sameas.io import csv, read_table, write_table


def refusal(path, content=None, **how):
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_table(path, **how)
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    return message


def test_a_missing_file_names_similar_ones(tmp_path):
    (tmp_path / "gaia_dr3.fits").touch()
    (tmp_path / "notes.txt").touch()
    message = refusal(tmp_path / "gaia_dr2.fits")
    assert "no such file; did you mean gaia_dr3.fits?" in message
    assert f"no such file in {tmp_path}" in refusal(tmp_path / "zzz.csv")
    assert "the directory" in refusal(tmp_path / "nowhere" / "x.csv")


def test_directories_empty_files_and_unknown_names(tmp_path):
    (tmp_path / "d.fits").mkdir()
    assert "is a directory" in refusal(tmp_path / "d.fits")
    assert "is empty" in refusal(tmp_path / "e.csv", b"")
    assert "'.xlsx' is not known; known are .fits" in refusal(tmp_path / "t.xlsx", b"x")
    assert "spreadsheet (.xlsx, .ods), not a table; unpack it, or save it as CSV" in refusal(
        tmp_path / "t.ods", b"PK\x03\x04"
    )
    assert "an HDF5 file, not a table; open it in Python" in refusal(tmp_path / "t.h5", b"\x89HDF\r\n")
    assert "no extension" in refusal(tmp_path / "table", b"x")
    assert "unknown format 'dbase'" in refusal(tmp_path / "t.csv", b"x", format="dbase")
    assert "only FITS" in refusal(tmp_path / "t.csv", b"a,b\n1,2\n", hdu=1)


@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
def test_content_that_does_not_match_the_extension(ending, tmp_path):
    path = tmp_path / f"t{ending}"
    assert "is a PNG picture" in refusal(path, b"\x89PNG\r\n\x1a\n" + b"\x00" * 100)
    page = b"\n<!DOCTYPE html>\n<html><body>503 Service Unavailable</body></html>"
    assert "is a web page (HTML)" in refusal(path, page) and "download" in refusal(path, page)
    assert "ZIP" in refusal(path, b"PK\x03\x04" + b"\x00" * 100)


@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".parquet"])
def test_text_that_is_no_table(ending, tmp_path):
    assert "is not a" in refusal(tmp_path / f"t{ending}", b"hello") or ending == ".vot"


def test_another_format_is_named_with_the_remedy(tmp_path):
    write_table(Table({"x": [1]}), tmp_path / "t.fits", provenance={})
    (tmp_path / "t.fits").rename(tmp_path / "t.csv")
    assert "is a FITS file, not CSV; rename it, or give format='fits'" in refusal(tmp_path / "t.csv")
    assert read_table(tmp_path / "t.csv", format="fits")["x"][0] == 1


@pytest.mark.parametrize("ending", [".fits", ".vot", ".parquet", ".fits.gz", ".csv.gz", ".ecsv.gz", ".vot.gz"])
@pytest.mark.parametrize("share", [0.95, 0.7, 0.2])
def test_truncated_files_are_refused(ending, share, tmp_path):
    path = tmp_path / f"t{ending}"
    rng = np.random.default_rng(1)
    write_table(Table({"x": rng.random(2160), "y": rng.random(2160)}), path, provenance={})
    whole = path.read_bytes()
    refusal(path, whole[: int(len(whole) * share)])


def test_a_truncated_fits_file_is_reported(tmp_path):
    path = tmp_path / "t.fits"
    write_table(Table({"x": np.arange(5000.0)}), path, provenance={})
    assert "is cut off: 20000 of" in refusal(path, path.read_bytes()[:20000])


def test_fits_without_a_table(tmp_path):
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(tmp_path / "image.fits")
    assert "holds images only, no table" in refusal(tmp_path / "image.fits")


def test_the_message_of_a_votable_without_table_is_reported(tmp_path):
    text = b"""<?xml version="1.0"?><VOTABLE version="1.3" xmlns="http://www.ivoa.net/xml/VOTable/v1.3">
<RESOURCE type="results"><INFO name="QUERY_STATUS" value="ERROR">Unknown table gaia.dr9</INFO></RESOURCE>
</VOTABLE>"""
    assert "has no table in it; it says: Unknown table gaia.dr9" in refusal(tmp_path / "t.vot", text)


def test_a_zipped_name_on_an_unzipped_file(tmp_path):
    assert "is not a gzip file" in refusal(tmp_path / "t.csv.gz", b"a,b\n1,2\n")
    assert "is cut off" in refusal(tmp_path / "t.csv.gz", gzip.compress(b"a,b\n" * 9)[:-9])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b,a\n1,2,3\n", "two columns are called a; rename one"),
        ("a,b\n1,2\n3,4\n5,6,7\n8,9\n", "line 4 has 3 cells, not 2; put text with a delimiter in it in quotes"),
        ("# c\n\na,b\n1,2\n3\n", "line 5 has 1 cells, not 2"),
        ("1,2.5,3\n4,5.5,6\n", "line 1 holds numbers; put the names of the columns above"),
        ("id ra dec\n1 2\n", "line 2 has 2 cells, not 3"),
        ("# only\n# comments\n", "has no line with the names"),
    ],
)
def test_malformed_csv(text, words, tmp_path):
    import re

    assert re.search(words, refusal(tmp_path / "t.csv", text.encode()))


@pytest.mark.slow
def test_the_line_of_a_bad_row_is_right_in_a_long_file(tmp_path):
    rows = [f"{n},{n / 7}" for n in range(200_000)]
    rows[150_000] += ",extra"
    assert "line 150002 has 3 cells" in refusal(tmp_path / "t.csv", ("a,b\n" + "\n".join(rows)).encode())


def test_csv_that_is_not_utf8(tmp_path):
    # 0x81 stands for nothing in Windows-1252 either.
    assert "column name is not UTF-8" in refusal(tmp_path / "t.csv", b"name,n\n\x81,1\n")
    # Arrow's own traceback for a row that it cannot decode would be a warning here, and an error.
    assert "(line 3); save it as UTF-8" in refusal(tmp_path / "t.csv", b"name,n\na,1\n\x81,1,2\n")
    assert "(line 1); save it as UTF-8" in refusal(tmp_path / "t.csv", b"\x81,n\n1,1\n")
    assert "line 3 has 3 cells" in refusal(tmp_path / "t.csv", "name,n\na,1\nÅ,1,2\n".encode("latin-1"))
    header = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\na\n1\n"
    message = refusal(tmp_path / "t.ecsv", header.encode("utf-16"))
    assert "is UTF-16 text, not ECSV; save it as UTF-8" in message
    assert "is UTF-16 text, not CSV" in refusal(tmp_path / "t.csv", b"\xff\xfe" + bytes(99))


@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
def test_columns_that_are_no_cells_are_refused_and_nothing_is_written(ending, tmp_path):
    path = tmp_path / f"out{ending}"
    with pytest.raises(InputError, match=rf"out{ending}: column where is a SkyCoord; write its parts"):
        write_table(Table({"where": SkyCoord([1], [2], unit="deg")}), path, provenance={})
    with pytest.raises(InputError, match="out"):
        write_table(Table({"odd": np.array([{1: 2}, object()], dtype=object)}), tmp_path / "out.parquet", provenance={})
    with pytest.raises(InputError, match="provenance: rule is a dict"):
        write_table(Table({"x": [1]}), path, provenance={"rule": {}})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".fits", ".vot", ".csv", ".parquet", ".ecsv"])
def test_lists_of_records_in_cells_are_refused_with_the_formats_that_hold_them(ending, tmp_path):
    cells = np.empty(2, dtype=object)
    cells[:] = np.array([{"mjd": 1.0, "mag": 20.0}]), np.array([], dtype=object)
    if ending in (".parquet", ".ecsv"):
        write_table(Table({"light": cells}), tmp_path / f"out{ending}", provenance={})
        return
    with pytest.raises(InputError, match=r"column light has lists .* no room for them, write \.parquet or \.ecsv"):
        write_table(Table({"light": cells}), tmp_path / f"out{ending}", provenance={})


def test_a_truncated_last_line_is_reported(tmp_path):
    assert "the last line is incomplete, the file was cut off" in refusal(tmp_path / "t.csv", b"a,b,c\n1,2,3\n4,5")
    for name, head in (("t.csv", b"a,b\n"), ("t.ecsv", b"# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n"
                       b"# - {name: a, datatype: int64}\n# - {name: b, datatype: int64}\na,b\n")):  # fmt: skip
        path = tmp_path / name
        for rows, notes in ((b"1,2\n3,4\n", 0), (b"1,2\n3,4", 1)):
            path.write_bytes(head + rows)
            table = read_table(path)
            assert len(table) == 2 and len(table.meta.get("sameas_notes", ())) == notes


VOTABLE = """<?xml version="1.0"?>{doctype}<VOTABLE version="1.3" xmlns="http://www.ivoa.net/xml/VOTable/v1.3"><RESOURCE>
<TABLE><FIELD name="ra" datatype="double" unit="deg"/><DATA><FITS>{stream}</FITS></DATA></TABLE></RESOURCE></VOTABLE>"""


@pytest.mark.parametrize(
    ("doctype", "stream", "encoding"),
    [
        ("", '<STREAM href="{}"/>', "utf-8"),
        ("", '<STREAM type="a>b" href = "{}"/>', "utf-16"),
        ("<!DOCTYPE VOTABLE [<!ENTITY s \"&#60;STR&#69;AM hr&#101;f='{}'/>\">]>", "&s;", "utf-8"),
    ],
)
@pytest.mark.parametrize("packed", ["", "votable", "parquet"])
def test_a_votable_with_remote_rows_is_refused_and_nothing_is_loaded(
    doctype, stream, encoding, packed, tmp_path, monkeypatch
):
    loaded = []
    monkeypatch.setattr(urllib.request, "urlopen", loaded.append)
    place = (tmp_path / "secret").as_uri()
    content = VOTABLE.format(doctype=doctype.format(place), stream=stream.format(place)).encode(encoding)
    if packed == "parquet":
        path = tmp_path / "t.parquet"
        kept = pa.schema([pa.field("ra", pa.float64())], metadata={"IVOA.VOTable-Parquet.content": content})
        parquet.write_table(pa.table([[1.0]], schema=kept), path)
        with pytest.raises(InputError, match="rows lie elsewhere"):
            read_table(path)
    else:
        name = "t.vot.gz" if packed else "t.vot"
        message = refusal(tmp_path / name, gzip.compress(content) if packed else content)
        assert "rows lie elsewhere" in message or (encoding == "utf-16" and "is UTF-16 text" in message)
    assert not loaded


def test_metadata_that_expand_without_limit_are_refused(tmp_path):
    names = "abcdefghij"
    lines = [f"#   {b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in pairwise(names)]
    for meta in (["#   a: &a [x, x]", *lines], ["#   a: &a [x, *a]"]):
        head = ["# %ECSV 1.0", "# ---", "# datatype:", "# - {name: ra, datatype: float64}", "# meta:", *meta]
        text = "\n".join([*head, "# schema: astropy-2.0", "ra", "1.0", ""]).encode()
        assert "its metadata unfold to more than 1000000 values" in refusal(tmp_path / "t.ecsv", text)


def test_tables_with_too_many_columns_are_refused(tmp_path):
    names = [f"c{k}" for k in range(6000)]
    message = "has 6000 columns; tables of up to 5000 are read"
    row = "1," * 5999 + "1\n"
    assert message in refusal(tmp_path / "t.csv", (",".join(names) + "\n" + row).encode())
    fields = "".join(f'<FIELD name="{name}" datatype="double"/>' for name in names)
    assert message in refusal(tmp_path / "t.vot", f"<VOTABLE><TABLE>{fields}</TABLE></VOTABLE>".encode())
    columns = "".join(f"# - {{name: {name}, datatype: float64}}\n" for name in names)
    text = f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}# schema: astropy-2.0\n{','.join(names)}\n{row}"
    assert message in refusal(tmp_path / "t.ecsv", text.encode())
    parquet.write_table(pa.table({name: [1.0] for name in names}), tmp_path / "t.parquet")
    with pytest.raises(InputError, match=message):
        read_table(tmp_path / "t.parquet")


def test_many_columns_of_numbers_beyond_63_bits_are_read_quickly(tmp_path, monkeypatch):
    calls, arrow = [], csv._arrow

    def counted(*given):
        calls.append(given)
        return arrow(*given)

    monkeypatch.setattr(csv, "_arrow", counted)
    names = [f"c{k}" for k in range(40)]
    values = [str(2**63 + 2**11 + 1), "9.3e18"] * 20
    (tmp_path / "t.csv").write_text(",".join(names) + "\n" + ",".join(values) + "\n")
    table = read_table(tmp_path / "t.csv")
    assert table["c0"][0] == 2**63 + 2**11 + 1 and table["c1"][0] == 9.3e18 and len(calls) == 3
