"""Round trips of every kind of column through every format."""

import gzip
import json
import os
import warnings
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.table.meta import get_header_from_yaml, get_yaml_from_table
from astropy.time import Time
from astropy.utils import minversion
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.io import read_table, write_table, written_formats
from sameas.io.parquet import described_by, header_of

ENDINGS = [extensions[0] for extensions in written_formats().values()]
ZIPPED = [".fits.gz", ".vot.gz", ".ecsv.gz", ".csv.gz", ".tsv"]
TYPED = [".fits", ".vot", ".ecsv", ".parquet"]
NEW_PYARROW = int(pyarrow.__version__.partition(".")[0]) >= 26
GAIA = np.array([5_853_498_713_190_525_696, 4_472_832_130_942_575_872, 9_007_199_254_740_993], np.int64)


def through(table, ending, directory, **provenance):
    path = Path(directory) / f"table{ending}"
    write_table(table, path, provenance=provenance)
    return read_table(path)


def assert_same(one, other):
    assert one.colnames == other.colnames
    for name in one.colnames:
        a, b = np.ma.asarray(one[name]), np.ma.asarray(other[name])
        np.testing.assert_array_equal(np.ma.getmaskarray(a), np.ma.getmaskarray(b), err_msg=name)
        keep = ~np.ma.getmaskarray(a)
        np.testing.assert_array_equal(a.data[keep], b.data[keep], err_msg=name)


@pytest.mark.parametrize("ending", ENDINGS + ZIPPED)
def test_numbers_truth_text_and_masks_survive(ending, tmp_path):
    table = Table(
        {
            "source_id": MaskedColumn(GAIA, mask=[False, True, False]),
            "whole_id": GAIA,
            "x": [1.5, np.nan, -1e300],
            "single": np.array([0.5, -2.25, 3.0], np.float32),
            "good": [True, False, True],
            "maybe": MaskedColumn([True, False, True], mask=[False, False, True]),
            "name": ["Sirius", 'a, b "c"; d', "#1 tab\tin"],
            "alias": MaskedColumn(["x", "", "z"], mask=[False, True, False]),
        }
    )
    again = through(table, ending, tmp_path)
    assert_same(table, again)
    assert again["source_id"].dtype == np.int64 and again["maybe"].dtype == bool
    assert again["name"].dtype.kind == "U"


@pytest.mark.parametrize("ending", TYPED)
def test_kinds_units_descriptions_and_ucds_survive(ending, tmp_path):
    table = Table({"ra": [1.0, 2.0], "mag": np.array([9, 8], np.float32), "n": np.array([1, 2], np.int16)})
    table["ra"].unit, table["ra"].description = u.deg, "right ascension"
    table["ra"].meta["ucd"] = "pos.eq.ra;meta.main"
    table["mag"].unit = u.mag
    table["n"].unit = u.mas / u.yr
    again = through(table, ending, tmp_path)
    assert [again[name].dtype for name in again.colnames] == [table[name].dtype for name in table.colnames]
    assert [again[name].unit for name in again.colnames] == [u.deg, u.mag, u.mas / u.yr]
    assert again["ra"].description == "right ascension"
    assert again["ra"].meta["ucd"] == "pos.eq.ra;meta.main"


@pytest.mark.parametrize("ending", [".vot", ".ecsv", ".csv", ".parquet"])
def test_letters_of_any_alphabet_survive(ending, tmp_path):
    table = Table({"name": ["Ångström", "Βερενίκη", "星", "🌟 twice 🌟"], "n": [1, 2, 3, 4]})
    assert_same(table, through(table, ending, tmp_path))


def test_fits_refuses_letters_it_cannot_hold_and_leaves_nothing(tmp_path):
    table = Table({"name": ["Vega", "Ångström"]})
    with pytest.raises(InputError, match=r"out\.fits.*name.*cannot hold \(row 1: Ångström\).*\.parquet"):
        write_table(table, tmp_path / "out.fits", provenance={})
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("ending", TYPED)
@pytest.mark.parametrize("kind", ["u1", "i2", "i4", "i8", "u2", "u4", "f4", "f8"])
def test_every_kind_of_number_survives_with_and_without_masks(ending, kind, tmp_path):
    limits = np.iinfo(kind) if kind[0] in "iu" else np.finfo(kind)
    values = np.array([limits.min, 0, 1, limits.max], kind)
    table = Table({"x": values, "y": MaskedColumn(values[[1, 2, 2, 3]], mask=[False, True, False, False])})
    again = through(table, ending, tmp_path)
    if kind[0] == "f" and ending == ".fits":  # FITS has NaN as the only missing float
        assert np.isnan(again["y"][1])
        table["y"] = table["y"].filled(np.nan)
    assert_same(table, again)


@pytest.mark.parametrize("ending", ENDINGS)
def test_identifiers_beyond_63_bits_survive(ending, tmp_path):
    ids = np.array([2**64 - 1, 2**63, 12], np.uint64)
    again = through(Table({"id": ids}), ending, tmp_path)
    assert [str(cell) for cell in again["id"]] == [str(cell) for cell in ids]


@pytest.mark.parametrize("ending", TYPED)
def test_columns_of_several_dimensions_survive(ending, tmp_path):
    table = Table(
        {
            "cov": np.arange(12.0).reshape(2, 2, 3),
            "flags": np.array([[True, False], [False, True]]),
            "pair": np.array([["a", "bcd"], ["ef", "g"]]),
            "n": np.array([[1, 2], [3, 4]]),
        }
    )
    if ending == ".vot":
        del table["pair"]
    assert_same(table, through(table, ending, tmp_path))


def test_csv_writes_one_column_a_dimension(tmp_path):
    again = through(Table({"cov": np.arange(4.0).reshape(2, 2)}), ".csv", tmp_path)
    assert again.colnames == ["cov_1", "cov_2"]
    with pytest.raises(InputError, match="two columns would be called cov_1"):
        through(Table({"cov": np.zeros((2, 2)), "cov_1": [1, 2]}), ".csv", tmp_path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_table_without_rows_is_a_table(ending, tmp_path):
    table = Table({"id": np.zeros(0, np.int64), "x": np.zeros(0), "s": np.zeros(0, "U3"), "b": np.zeros(0, bool)})
    again = through(table, ending, tmp_path)
    assert again.colnames == table.colnames and len(again) == 0


@pytest.mark.parametrize("ending", ENDINGS)
def test_columns_without_any_value_survive(ending, tmp_path):
    table = Table({"n": [1, 2], "id": MaskedColumn([7, 8], mask=True), "s": MaskedColumn(["a", "b"], mask=True)})
    again = through(table, ending, tmp_path)
    assert again["id"].mask.all() and again["s"].mask.all()


@pytest.mark.parametrize("ending", ENDINGS)
def test_very_long_texts_survive(ending, tmp_path):
    table = Table({"note": np.array(["short", "long " * 200 + "end"], dtype=object), "n": [1, 2]})
    assert_same(table, through(table, ending, tmp_path))


@pytest.mark.parametrize("ending", ENDINGS)
def test_quantities_and_times_become_plain_columns(ending, tmp_path):
    table = QTable({"ra": [1.0, 2.0] * u.deg, "t": Time(["2016-01-01T00:00:00", "2017-01-01T12:00:00"])})
    again = through(table, ending, tmp_path)
    assert list(again["ra"]) == [1.0, 2.0]
    assert again["t"][1] == "2017-01-01T12:00:00.000"


CELLS = {
    "whole": (st.integers(-(2**63), 2**63 - 1), np.int64),
    "real": (st.floats(allow_infinity=False), np.float64),
    "single": (st.floats(width=32, allow_infinity=False), np.float32),
    "truth": (st.booleans(), bool),
    "text": (st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=9), str),
}


@st.composite
def tables(draw):
    n = draw(st.integers(1, 6))
    table = Table()
    for name, (cells, kind) in CELLS.items():
        values = np.array(draw(st.lists(cells, min_size=n, max_size=n)), dtype=kind)
        mask = draw(st.lists(st.booleans(), min_size=n, max_size=n))
        table[name] = MaskedColumn(values, mask=mask)
    return table


@pytest.mark.slow
@pytest.mark.parametrize("ending", TYPED)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(table=tables())
def test_any_table_survives(ending, tmp_path, table):
    # In ECSV this text is no value: the Gaia archive writes it.
    assume(ending != ".ecsv" or "null" not in table["text"].data.data)
    again = through(table, ending, tmp_path)
    if ending == ".fits":
        for name in ("real", "single"):
            table[name] = table[name].filled(np.nan)
    assert_same(table, again)


@pytest.mark.parametrize("ending", [*TYPED, ".csv"])
def test_astropy_reads_what_we_write(ending, tmp_path, monkeypatch):
    from astropy.io.misc import parquet

    # Its reader tries pandas first and works without it if pyarrow is installed.
    monkeypatch.setattr(parquet, "HAS_PANDAS", True, raising=False)
    if ending == ".parquet" and not NEW_PYARROW:
        pytest.importorskip("pandas")
    path = tmp_path / f"t{ending}"
    table = Table({"id": GAIA, "ra": Column([1.0, 2.5, 3.0], unit="deg"), "s": ["a", "Vega", "c d"], "b": [True] * 3})
    write_table(table, path, provenance={"software": "sameas"})
    formats = {".vot": "votable", ".csv": "ascii.csv", ".ecsv": "ascii.ecsv"}
    again = Table.read(path, format=formats.get(ending, ending[1:]))
    assert list(again["id"]) == list(GAIA) and list(again["ra"]) == [1.0, 2.5, 3.0]
    assert [str(s) for s in again["s"]] == ["a", "Vega", "c d"]
    assert ending == ".csv" or again["ra"].unit == u.deg


@pytest.mark.parametrize("ending", TYPED)
def test_we_read_what_astropy_writes(ending, tmp_path):
    path = tmp_path / f"t{ending}"
    table = Table(
        {
            "id": MaskedColumn(GAIA, mask=[False, True, False]),
            "ra": Column([1.0, np.nan, 3.0], unit="deg", description="angle"),
            "s": MaskedColumn(["a", "Vega", "c d"], mask=[True, False, False]),
        }
    )
    table.write(path, format={".vot": "votable", ".ecsv": "ascii.ecsv"}.get(ending, ending[1:]))
    again = read_table(path)
    assert list(again["id"].mask) == [False, True, False]
    assert [again["id"][0], again["id"][2]] == [GAIA[0], GAIA[2]]
    assert again["ra"].unit == u.deg and again["ra"].description == "angle" and again["ra"][2] == 3.0
    assert again["s"].mask[0] and list(again["s"][1:]) == ["Vega", "c d"]


def test_fits_gives_native_copies_and_keeps_the_header(tmp_path):
    path = tmp_path / "t.fits"
    header = fits.Header([("EPOCH", 1991.25), ("TELESCOP", "HIP")])
    columns = [fits.Column("ra", "D", array=[1.0], unit="degrees"), fits.Column("id", "K", array=[-99], null=-99)]
    hdu = fits.BinTableHDU.from_columns(columns, header=header)
    hdu.header["TUCD1"] = "pos.eq.ra"
    hdu.writeto(path)
    table = read_table(path)
    os.remove(path)
    assert table.meta["EPOCH"] == 1991.25 and table.meta["TELESCOP"] == "HIP"
    assert table["ra"].dtype.isnative and table["ra"][0] == 1.0
    assert str(table["ra"].unit) == "degrees" and table["ra"].meta["ucd"] == "pos.eq.ra"
    assert table["id"].mask[0]


def test_the_first_of_several_fits_tables_is_read_and_reported(tmp_path):
    path = tmp_path / "t.fits"
    two = [fits.BinTableHDU(Table({"x": [n]}), name=name) for n, name in ((1, "STARS"), (2, "GALAXIES"))]
    fits.HDUList([fits.PrimaryHDU(), *two]).writeto(path)
    table = read_table(path)
    assert table["x"][0] == 1
    note = "holds 2 tables, extensions 1 (STARS), 2 (GALAXIES); used 1, without the 1 row of the others"
    assert note in table.meta["sameas_notes"][0]
    assert read_table(path, hdu="GALAXIES")["x"][0] == 2
    assert read_table(path, hdu=2)["x"][0] == 2
    assert read_table(path, hdu="2")["x"][0] == 2
    with pytest.raises(InputError, match=r"has no extension 7; its tables are 1 \(STARS\)"):
        read_table(path, hdu=7)
    with pytest.raises(InputError, match="extension 0 is not a table"):
        read_table(path, hdu=0)


def test_metadata_of_fits_survives_fits(tmp_path):
    table = Table({"x": [1]}, meta={"EPOCH": 2000.0, "OBJECT": "M 31", "comments": ["made by hand"]})
    again = through(table, ".fits", tmp_path, software="sameas")
    assert again.meta == {"EPOCH": 2000.0, "OBJECT": "M 31", "comments": ["made by hand"]}


def write_text(path, text):
    path.write_text(text, encoding="utf-8")
    return read_table(path)


def test_csv_names_comments_blanks_and_missing_cells(tmp_path):
    table = write_text(
        tmp_path / "t.csv",
        "# made by hand\n#\n\nid, ra[deg],DE (deg),seen,name\n1, 10.5,,true,a\n,null,  ,,\n3,nan,-2.5,false,NGC 1\n",
    )
    assert table.colnames == ["id", "ra[deg]", "DE (deg)", "seen", "name"]
    assert [table[name].dtype.kind for name in table.colnames] == ["i", "f", "f", "b", "U"]
    assert list(table["id"].mask) == [False, True, False]
    assert np.isnan(table["ra[deg]"][2]) and table["ra[deg]"].mask[1] and not table["ra[deg]"].mask[2]
    assert list(table["DE (deg)"].mask) == [True, True, False]


@pytest.mark.parametrize("delimiter", [";", "\t", "|"])
def test_csv_finds_the_delimiter(delimiter, tmp_path):
    table = write_text(tmp_path / "t.txt", f"\ufeffa{delimiter}b\r\n1{delimiter}2.5\r\n")
    assert table.colnames == ["a", "b"] and table["b"][0] == 2.5


def test_csv_takes_names_from_a_comment_line(tmp_path):
    assert write_text(tmp_path / "t.csv", "# v1\n#id,ra,dec\n1,2.5,3\n").colnames == ["id", "ra", "dec"]


def test_csv_keeps_dates_unchanged(tmp_path):
    table = write_text(tmp_path / "t.csv", "day,n\n2016-01-01,1\n2017-05-03,2\n")
    assert list(table["day"]) == ["2016-01-01", "2017-05-03"]


def test_csv_keeps_line_ends_within_quotes(tmp_path):
    table = Table({"s": ["one\ntwo", 'three "3"'], "n": [1, 2]})
    assert_same(table, through(table, ".csv", tmp_path))


def test_a_gz_file_is_compressed(tmp_path):
    write_table(Table({"x": [1]}), tmp_path / "t.csv.gz", provenance={})
    assert gzip.decompress((tmp_path / "t.csv.gz").read_bytes()) == b"x\n1\n"


def test_votable_of_other_software(tmp_path):
    table = write_text(
        tmp_path / "t.xml",
        """<?xml version="1.0"?><VOTABLE version="1.3" xmlns="http://www.ivoa.net/xml/VOTable/v1.3"><RESOURCE>
<COOSYS ID="c" system="ICRS" epoch="J2015.5"/><TABLE><PARAM name="radius" datatype="double" value="2.5"/>
<FIELD name="Gaia DR2" ID="col1" datatype="long" ucd="meta.id"><VALUES null="-1"/></FIELD>
<FIELD name="name" datatype="char" arraysize="*"/><FIELD name="pm" datatype="float" unit="mas/yr"/>
<DATA><TABLEDATA><TR><TD>5853498713190525696</TD><TD>Proxima</TD><TD>3.5</TD></TR>
<TR><TD>-1</TD><TD/><TD/></TR></TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>""",
    )
    assert table.colnames == ["Gaia DR2", "name", "pm"]
    assert table["Gaia DR2"][0] == 5853498713190525696 and table["Gaia DR2"].mask[1]
    assert table["Gaia DR2"].meta["ucd"] == "meta.id" and table["pm"].unit == u.mas / u.yr
    assert table["name"].dtype.kind == "U" and table["name"].mask[1]
    assert table.meta["radius"] == 2.5 and table.meta["coosys_epoch"] == "J2015.5"
    assert_same(table, through(table, ".vot", tmp_path))


def test_parquet_of_other_software(tmp_path):
    import pyarrow as pa
    from pyarrow import parquet

    content = pa.table(
        {
            "id": pa.array([2**60 + 1, None, 3], pa.int64()),
            "band": pa.array(["g", None, "g"]).dictionary_encode(),
            "when": pa.array([0, 1, None], pa.timestamp("s")),
            "cost": pa.array([1, 2, 3], pa.decimal128(5, 2)),
            "odd": pa.array([{"a": 1}] * 3),
        }
    )
    if NEW_PYARROW:  # an older one cannot write or read it
        content = content.append_column("pair", pa.array([[1, 2], None, [None, 4]], pa.list_(pa.int32(), 2)))
    parquet.write_table(content, tmp_path / "t.parquet")
    table = read_table(tmp_path / "t.parquet")
    assert table["id"][0] == 2**60 + 1 and table["id"].mask[1]
    assert table["band"].dtype.kind == "U" and table["band"].mask[1]
    assert table["when"][1].startswith("1970-01-01T00:00:01")
    assert table["cost"][2] == 3.0
    assert not NEW_PYARROW or table["pair"].mask.tolist() == [[False, False], [True, True], [True, False]]
    assert "column odd" in table.meta["sameas_notes"][0]


def test_harmless_astropy_warnings_are_suppressed(tmp_path):
    table = Table({"x y": [1.0]})
    table["x y"].unit = u.Unit("wobble", parse_strict="silent")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for ending in TYPED:
            assert through(table, ending, tmp_path).colnames == ["x y"]


def test_every_known_extension_is_written_and_read(tmp_path):
    for extensions in written_formats().values():
        for ending in extensions:
            assert_same(
                Table({"x": [1, 2], "y": [1.5, 2.5]}), through(Table({"x": [1, 2], "y": [1.5, 2.5]}), ending, tmp_path)
            )


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("column", [MaskedColumn([1, 2, 3], mask=[0, 1, 1]), MaskedColumn(["a", "b"], mask=[1, 0])])
def test_a_missing_cell_is_a_row_even_when_it_is_alone(ending, column, tmp_path):
    table = Table({"only": column})
    assert_same(table, through(table, ending, tmp_path))


@pytest.mark.parametrize("ending", [".fits", ".vot", ".parquet"])
def test_lists_of_several_lengths_survive(ending, tmp_path):
    lists = np.empty(3, dtype=object)
    lists[:] = [np.array([1.5]), np.array([2.5, 3.5]), np.array([])]
    again = through(Table({"n": [1, 2, 3], "v": lists}), ending, tmp_path)
    assert [list(cell) for cell in again["v"]] == [[1.5], [2.5, 3.5], []]


@pytest.mark.parametrize("ending", ENDINGS)
def test_any_column_name_is_written(ending, tmp_path):
    table = Table({"RA (deg)": [1.0], "pm[mas/yr]": [2.0], "a,b": [3.0]})
    assert_same(table, through(table, ending, tmp_path))


@pytest.mark.parametrize(
    "more", [None, (1, 2), np.float64(3.0), np.str_("text"), 1j, u.m, Time(2016.0, format="jyear")]
)
def test_astropy_reads_our_parquet_like_its_own_and_we_read_its(more):
    """Plain values without the half of astropy, anything else with it."""
    if isinstance(more, np.str_) and not minversion("astropy", "7.2"):
        pytest.skip("this astropy cannot write NumPy's text in metadata itself")
    table = Table({"b": [1.0, 2.0], "a": ["x", "é"], "c": MaskedColumn([True, False], mask=[0, 1]), "d": [[1], [2]]})
    table["b"].unit, table["b"].format = u.mas / u.yr, ".3f"
    table["b"].description = "with #: and 'quotes', and so long that it has to go on in the line after, " * 2
    table["a"].meta["ucd"] = "meta.id;meta.main"
    table.meta.update(z=1, list=["a", "b"], small=1e-30, none=None, nan=np.nan, nested={"y": 1, "x": [1.5, {"k": "v"}]})
    if more is not None:
        table.meta["more"] = more
    lines = get_yaml_from_table(table)
    assert header_of(table) == lines
    ours, theirs = described_by("\n".join(lines)), get_header_from_yaml(lines)
    assert json.dumps(ours, default=repr) == json.dumps(theirs, default=repr)


def test_pandas_reads_identifiers_with_nulls_from_parquet_exactly(tmp_path):
    # As floats, which pandas makes of whole numbers with a null unless told otherwise, 64-bit identifiers are rounded.
    pandas = pytest.importorskip("pandas")
    long = 4_611_686_018_427_387_905
    table = Table({"plain": [1, 2], "x": [0.5, 1.5]})
    table["source_id"] = MaskedColumn([long, 7], mask=[False, True])
    table["flag"] = MaskedColumn([True, False], mask=[False, True])
    write_table(table, tmp_path / "t.parquet", provenance={})
    frame = pandas.read_parquet(tmp_path / "t.parquet")
    assert frame["source_id"].iloc[0] == long and frame["source_id"].isna().tolist() == [False, True]
    assert [str(kind) for kind in frame.dtypes] == ["int64", "float64", "Int64", "boolean"]
    assert frame.index.tolist() == [0, 1]
