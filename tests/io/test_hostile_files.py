"""Hostile files are read or refused in one line, within seconds and bounded memory."""

import base64
import gzip
import struct
import time

import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits
from pyarrow import parquet

from sameas.errors import InputError
from sameas.io import read_provenance, read_table
from sameas.io.ades import Observer
from sameas.io.catalogues import catalogue
from sameas.io.format import has_huge_power
from sameas.io.sensors import ReadOptions, read_reports
from sameas.sky.frame.field import Cone

SECONDS = 5.0


@pytest.fixture(autouse=True)
def within_seconds():
    began = time.process_time()
    yield
    assert time.process_time() - began < SECONDS


def read(path, content, reader=read_table):
    """The number of rows of a file, or the text of its refusal."""
    path.write_bytes(content)
    assert len(content) < 1 << 20
    try:
        found = reader(path)
    except InputError as error:
        message = str(error)
        assert "\n" not in message
        return message
    return len(found) if reader is read_table else sum(map(len, found))


def votable(fields, rows, table=""):
    text = f'<VOTABLE version="1.3"><RESOURCE><TABLE {table}>{fields}<DATA>{rows}</DATA></TABLE></RESOURCE></VOTABLE>'
    return ('<?xml version="1.0"?>' + text).encode()


RA = '<FIELD name="ra" datatype="double"/>'
ROW = "<TABLEDATA><TR><TD>1</TD><TD>2</TD></TR></TABLEDATA>"


@pytest.mark.parametrize(
    "content",
    [
        votable(RA + RA.replace("ra", "dec"), ROW, 'nrows="2000000000"'),
        votable(RA + '<FIELD name="a" datatype="char" arraysize="300000000"/>', ROW),
        votable(RA + '<FIELD name="a" datatype="unicodeChar" arraysize="300000000*"/>', ROW),
        votable(RA + '<FIELD name="a" datatype="double" arraysize="20000x20000"/>', ROW),
        votable(RA + '<FIELD name="a" datatype="double" arraysize="&#x32;0000x20000"/>', ROW),
        votable(
            RA + '<FIELD name="a" datatype="char" arraysize="100000"/>', ROW.replace("</TABLEDATA>", "<TR/>" * 30000)
        ),
    ],
)
def test_votable_that_declares_more_cells_than_it_has(content, tmp_path):
    assert "takes more than 256 MB, by its nrows and arraysize" in read(tmp_path / "t.vot", content)


def test_votable_of_wide_columns_is_read(tmp_path):
    fields = RA + '<FIELD name="a" datatype="char" arraysize="5000"/><FIELD name="b" datatype="float" arraysize="9x*"/>'
    row = "<TR><TD>1</TD><TD>x</TD><TD>1 2 3 4 5 6 7 8 9</TD></TR>"
    assert read(tmp_path / "t.vot", votable(fields, f"<TABLEDATA>{row * 100}</TABLEDATA>", 'nrows="100"')) == 100
    cells = base64.b64encode(np.zeros(50_000, np.dtype("u1, >f8")).tobytes()).decode()
    stream = f'<BINARY2><STREAM encoding="base64">{cells}</STREAM></BINARY2>'
    assert read(tmp_path / "t.vot", votable(RA, stream, 'nrows="50000"')) == 50_000


@pytest.mark.parametrize("unit", ["10**99999999 deg", "10^(99999999)deg", "10+99999999deg", "mag(10**(+99999999) m)"])
def test_units_with_a_huge_power_are_not_expanded(unit, tmp_path):
    field = f'<FIELD name="dec" datatype="double" unit="{unit}"/>'
    assert "a power that no unit has" in read(tmp_path / "t.vot", votable(RA + field, ROW))
    assert read(tmp_path / "t.tsv", f"ra\tdec\n{unit}\tdeg\n-\t-\n1\t2\n".encode()) == 1
    assert read(tmp_path / "t.cat", f"#   1 RA  Right [{unit}]\n#   2 DEC  Decl [deg]\n1 2\n".encode()) == 1
    columns = [fits.Column("ra", "D", array=[1.0]), fits.Column("dec", "D", array=[2.0])]
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header["TUNIT2"] = unit
    hdu.writeto(tmp_path / "made.fits")
    assert read(tmp_path / "t.fits", (tmp_path / "made.fits").read_bytes()) == 1
    header = f"# %ECSV 1.0\n# ---\n# datatype:\n# - {{name: ra, unit: '{unit}', datatype: float64}}\n"
    assert "a power that no unit has" in read(tmp_path / "t.ecsv", (header + "ra\n1.0\n").encode())
    described = pa.field("ra", pa.float64(), metadata={"unit": unit})
    parquet.write_table(pa.table([[1.0]], schema=pa.schema([described])), tmp_path / "made.parquet")
    assert read(tmp_path / "t.parquet", (tmp_path / "made.parquet").read_bytes()) == 1


def test_units_of_catalogues_have_no_huge_power():
    units = [
        "deg",
        "mas / yr",
        "10**-3 arcsec",
        "10**(-17) erg / (s cm2 Angstrom)",
        "10+21m",
        "1e-16 W m**-2",
        "s^(3/2)",
    ]
    assert not any(map(has_huge_power, units))


@pytest.mark.parametrize("code", ["B", "A", "D"])
def test_fits_arrays_that_share_bytes(code, tmp_path):
    rows, heap = 20_000, 400_000
    lists = np.empty(rows, object)
    lists[:] = [np.zeros(1, "f8" if code == "D" else "u1")] * rows
    if code == "A":
        lists[:] = ["x"] * rows
    table = fits.BinTableHDU.from_columns([fits.Column("v", f"P{code}()", array=lists)])
    table.writeto(tmp_path / "made.fits")
    content = bytearray((tmp_path / "made.fits").read_bytes())
    begin = content.index(b"XTENSION") + 2880
    descriptors = np.array([(heap // 8, 0)] * rows, ">i4").tobytes()
    content[begin : begin + len(descriptors)] = descriptors
    assert "the arrays in column v take more than 256 MB" in read(tmp_path / "t.fits", bytes(content))


@pytest.mark.parametrize(
    ("name", "content", "rows"),
    [
        ("blank.csv", b"\n" * 60_000 + b"a,b\n1,2\n", 1),
        ("bars.csv", b"|a|" + b"\n" * 60_000 + b"x,y\n", None),
        ("end.tsv", b"a\tb\nu\tv\n-\t-\n1\t2\n" + b"\n" * 900_000 + b"#\n", 1),
        ("blanks.cat", b"#   1 NUMBER a" + b" " * 200_000 + b"b\n# 2 B  b\n1 2\n", 1),
        ("brackets.cat", b"#   1 NUMBER a" + b" [ " * 100_000 + b"b\n# 2 B  b\n1 2\n", 1),
    ],
)
def test_regular_expressions_run_in_linear_time(name, content, rows, tmp_path):
    assert read(tmp_path / name, content) == rows or rows is None


def test_sextractor_head_keeps_descriptions_and_units(tmp_path):
    path = tmp_path / "t.cat"
    path.write_bytes(b"#   1 NUMBER  Of [one] thing [pixel]\n#   2 FLUX  No unit [\n#   3 MAG\n1 2 3\n")
    table = read_table(path)
    assert [table[name].description for name in table.colnames] == ["Of [one] thing", "No unit [", None]
    assert str(table["NUMBER"].unit) == "pix"


def test_vizier_rows_end_before_the_blank_lines_above_a_comment(tmp_path):
    content = b"#x\na\tb\n \t \n-\t-\n1\t2\n3\t4\n  \n\n#Name: next\na\tb\n \t \n-\t-\n5\t6\n"
    assert read(tmp_path / "t.tsv", content) == 2


@pytest.mark.parametrize(
    ("ending", "head", "row"),
    [(".dat.gz", b"ra dec\n", b"1 2\n"), (".cat.gz", b"# 1 RA x\n# 2 DEC x\n", b"1 2\n"),
     (".tsv.gz", b"ra\tdec\n \t \n-\t-\n", b"1\t2\n"), (".csv.gz", b"ra,dec\n", b"1,2\n"),
     (".ecsv.gz", b"# %ECSV 1.0\n# ---\n# datatype:\n# - {name: ra, datatype: int64}\nra\n", b"1  \n"),
     (".vot.gz", b'<VOTABLE version="1.3"><RESOURCE><TABLE><FIELD name="a" datatype="int"/><DATA><TABLEDATA>\n',
      b"<TR><TD>1</TD></TR>\n")],
)  # fmt: skip
def test_compressed_text_that_expands_without_limit(ending, head, row, tmp_path):
    content = gzip.compress(head + row * (40_000_000 // len(row)), 1)
    assert "unpacks to more than 32 MB" in read(tmp_path / f"t{ending}", content)


@pytest.mark.slow
def test_provenance_of_a_compressed_votable_is_read_in_bounded_memory(tmp_path):
    (tmp_path / "t.vot.gz").write_bytes(gzip.compress(b'<?xml version="1.0"?><VOTABLE>' + b" " * 300_000_000, 1))
    assert read_provenance(tmp_path / "t.vot.gz") == {}


# ---- sensors ----


def test_tables_with_too_many_columns(tmp_path):
    names = b",".join(b"c%d" % k for k in range(100_000))
    assert "has 100003 columns" in read(tmp_path / "t.csv", b"time,lat,lon," + names + b"\n1,2,3\n", read_reports)
    objects = b"".join(b'{"time":1,"lat":1,"lon":2,"c%d":1}\n' % k for k in range(25_000))
    assert "has 25003 columns" in read(tmp_path / "t.json", objects, read_reports)


def test_only_needed_columns_of_a_large_json_are_read(tmp_path):
    objects = b"".join(b'{"time":%d,"lat":1,"lon":2,"c%d":1}\n' % (k, k % 4000) for k in range(20_000))
    assert read(tmp_path / "t.json", objects, read_reports) == 20_000


@pytest.mark.parametrize(
    "line", [b"a" + b" " * 60_000 + b"b\n", b"8D40621D58C382D690C8AC2863A7\n" * 9 + b"a" + b" " * 900_000]
)
def test_long_lines_are_no_mode_s(line, tmp_path):
    assert isinstance(read(tmp_path / "t.txt", line, read_reports), str)


def sentence(body):
    return b"%s*%02X\n" % (body, int(np.bitwise_xor.reduce(list(body[1:]))))


@pytest.mark.slow
def test_many_static_reports_of_one_ship(tmp_path):
    pytest.importorskip("pyais")
    position = sentence(b"!AIVDM,1,1,,A,13P8fPP000ww:`tK>QqrqiL20000,0")
    static = sentence(b"!AIVDM,1,1,,A,H3P8fPQ0D<@000000000000000,0")
    clock = sentence(b"$GPZDA,120000.00,01,05,2024,00,00")
    assert read(tmp_path / "t.txt", clock + (position + static) * 9000, read_reports) == 9000


def test_parquet_of_equal_cells(tmp_path):
    zeros = pa.array(np.zeros(10_000_000))
    parquet.write_table(pa.table({"time": zeros, "lat": zeros, "lon": zeros}), tmp_path / "made.parquet")
    content = (tmp_path / "made.parquet").read_bytes()
    assert "says 30000000 cells; up to 16777216 are read" in read(tmp_path / "t.parquet", content, read_reports)
    zeros = np.zeros(11_000_000, np.int8)
    parquet.write_table(pa.table({"ra": zeros, "dec": zeros}), tmp_path / "made.parquet")
    message = read(tmp_path / "t.parquet", (tmp_path / "made.parquet").read_bytes())
    assert "claims 11000000 rows in" in message and "is it the right file?" in message


def test_compressed_log_that_expands_without_limit(tmp_path):
    content = gzip.compress(b"time,lat,lon\n" + b"1,2,3\n" * 10_000_000, 1)
    assert "unpacks to more than 32 MB" in read(tmp_path / "t.csv.gz", content, read_reports)


def test_names_that_no_file_can_have_and_unreadable_files_are_refused():
    for reader in (read_reports, read_table, lambda name: catalogue(name, None), Observer.read):
        with pytest.raises(InputError):
            reader("x" * 5000)
    with pytest.raises(InputError, match="cannot be read"):
        read_reports("/proc/self/mem", ReadOptions())


# ---- observers and folders ----

OBSERVER = (
    '[observatory]\nmpcCode="810"\n[submitter]\nname="J"\n[telescope]\ndesign="a"\naperture="1"\ndetector="c"\n'
    '[report]\nastCat="Gaia3"\n'
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("observers=5\n" + OBSERVER, "observers is 5, not a table"),
        ('comment="x"\n' + OBSERVER, "comment is 'x', not a table"),
        ('telescope="x"\n[observatory]\nmpcCode="810"\n', "telescope is 'x', not a table"),
        ("a=" + "[" * 3000, "is not TOML"),
    ],
)
def test_observers_of_the_wrong_shape(text, words, tmp_path):
    (tmp_path / "who.toml").write_text(text)
    with pytest.raises(InputError, match=words):
        Observer.read(tmp_path / "who.toml")


def test_a_single_observer_may_be_a_number(tmp_path):
    (tmp_path / "who.toml").write_text(OBSERVER + "[observers]\nname=5\n")
    assert Observer.read(tmp_path / "who.toml").observers == ("5",)


def test_folders_of_parquet_without_a_catalogue(tmp_path):
    path = tmp_path / "a.parquet"
    path.write_bytes(b"PAR1" + struct.pack("<q", -1))
    with pytest.raises(InputError, match="cannot be read as a catalogue of Parquet files"):
        catalogue(str(tmp_path), None)
    parquet.write_table(pa.table({"ra": ["a"], "dec": ["b"]}), path)
    with pytest.raises(InputError, match=r"column ra is string, not numbers; give ra=NAME"):
        catalogue(str(tmp_path), Cone(1.0, 2.0, 3.0))


def test_a_folder_with_lists_and_damaged_properties_is_read(tmp_path):
    parquet.write_table(pa.table({"ra": [1.0], "dec": [2.0], "flux": [[1.0, 2.0]]}), tmp_path / "a.parquet")
    (tmp_path / "properties").write_bytes(b"\xff\xfe=1\n")
    assert len(catalogue(str(tmp_path), None)) == 1
