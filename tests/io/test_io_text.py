"""Text tables in astronomy: recognised by content, for any extension, compressed or not."""

import gzip

import numpy as np
import pytest
from astropy.io import ascii as text_tables
from astropy.io import fits
from astropy.table import Table
from astropy.units import UnrecognizedUnit

from sameas.errors import InputError
from sameas.io import known_formats, read_table, write_table, written_formats

SEXTRACTOR = """\
#   1 NUMBER                 Running object number
#   2 ALPHA_J2000            Right ascension of barycenter (J2000)                   [deg]
#   3 DELTA_J2000            Declination of barycenter (J2000)                       [deg]
#   4 MAG_APER               Fixed aperture magnitude vector                         [mag]
#   6 FLAGS                  Extraction flags
         1 150.0279671 +2.1574850 14.25 14.50 0
         2 150.2373791 +2.1929207 99.0  99.0  3
"""
VIZIER = """\
#
#   VizieR Astronomical Server vizier.cds.unistra.fr
#Name: II/246
#Title: 2MASS All-Sky Catalog of Point Sources (Cutri+ 2003)
#Table\tII_246_out:
#Name: II/246/out
#Column\tRAJ2000\t(F10.6)\t(ra) Right ascension (J2000)\t[ucd=pos.eq.ra;meta.main]
#Column\tDate\t(A10)\tObservation date (Ep=1999)\t[ucd=time.epoch]

_2MASS           ;RAJ2000;DEJ2000 ;errMaj;Jmag;Date
 ;deg;deg;arcsec;mag;"Y:M:D"
----------------;----------;----------;----;------;----------
10000669+0209269;150.027870; +2.157520;0.08;13.079;2000-01-20
                ;150.237325; +2.192905;    ;      ;2000-01-20

"""
IPAC = """\
\\EPOCH_OF = 2010.5
\\ a comment
|         ra|       dec|sigra |  name|
|     double|    double|double|  char|
|        deg|       deg|arcsec|      |
|       null|      null|  null|  null|
 150.0279671  2.1574850   0.08   one
 150.2373791  2.1929207   null  null
"""
MRT = """\
Title: A table
Authors: Somebody
Table: 1
================================================================================
Byte-by-byte Description of file: table.dat
--------------------------------------------------------------------------------
 Bytes Format Units  Label     Explanations
--------------------------------------------------------------------------------
 1- 4  A4     ---    Name      Name of the star
 6-15  F10.6  deg    RAdeg     Right ascension (Ep=2016.0)
17-26  F10.6  deg    DEdeg     Declination
28-32  F5.3  mag     Vmag      ? Brightness
--------------------------------------------------------------------------------
"""
MRT_ROWS = "s001 150.027967   2.157485 14.25\ns002 150.237379   2.192920      \n"
BLANKS = "# made by hand\n# id ra dec name\n4472832130942575872 150.0279671 2.1574850 one\n2 1.5e2 -2 'x\n"


def read(path, text, encoding="utf-8"):
    data = text.encode(encoding)
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return read_table(path)


@pytest.mark.parametrize("ending", [".cat", ".txt", ".cat.gz", ".asc"])
def test_a_sextractor_catalogue(ending, tmp_path):
    table = read(tmp_path / f"s{ending}", SEXTRACTOR)
    assert table.colnames == ["NUMBER", "ALPHA_J2000", "DELTA_J2000", "MAG_APER", "MAG_APER_1", "FLAGS"]
    assert list(table["MAG_APER_1"]) == [14.5, 99.0] and table["FLAGS"].dtype.kind == "i"
    assert table["ALPHA_J2000"].unit == "deg" and "barycenter" in table["ALPHA_J2000"].description
    theirs = text_tables.read(SEXTRACTOR, format="sextractor")
    assert theirs.colnames == table.colnames and (theirs["MAG_APER"] == table["MAG_APER"]).all()


def test_a_sextractor_catalogue_with_inconsistent_comments(tmp_path):
    short = SEXTRACTOR.replace(" 14.25 14.50 0", "").replace(" 99.0  99.0  3", "")
    with pytest.raises(InputError, match=r"number 6 columns, but the first row has 3 cells"):
        read(tmp_path / "s.cat", short)
    with pytest.raises(InputError, match=r"line 7 has 5 cells, not 6"):
        read(tmp_path / "s.cat", SEXTRACTOR.replace("99.0  99.0  3", "99.0  3"))


def test_sextractor_columns_without_number_are_no_catalogue(tmp_path):
    """29 207 columns without a row took 20 s (found by fuzzing)."""
    comments = "".join(line + "\n" for line in SEXTRACTOR.splitlines() if line.startswith("#"))
    with pytest.raises(InputError, match="do not number the columns from 1 on"):
        read(tmp_path / "s.cat", comments + "# 29207 99.0  99.0  3\n")


@pytest.mark.parametrize("delimiter", [";", "\t", "|"])
@pytest.mark.parametrize("ending", [".tsv", ".csv", ".txt.gz", ".dat"])
def test_a_vizier_table(delimiter, ending, tmp_path):
    table = read(tmp_path / f"v{ending}", VIZIER.replace(";", delimiter).replace("ra" + delimiter, "ra;"))
    assert table.colnames == ["_2MASS", "RAJ2000", "DEJ2000", "errMaj", "Jmag", "Date"] and len(table) == 2
    assert table["RAJ2000"].unit == "deg" and table["errMaj"].unit == "arcsec" and table["Date"].unit is None
    assert table["RAJ2000"].meta["ucd"] == "pos.eq.ra;meta.main" and table["Date"].description.endswith("(Ep=1999)")
    assert table["DEJ2000"][0] == 2.15752 and list(table["_2MASS"].mask) == [False, True]
    assert list(table["errMaj"].mask) == list(table["Jmag"].mask) == [False, True]
    assert table.meta["title"].startswith("2MASS All-Sky") and table.meta["name"] == "II/246; II/246/out"


def test_a_vizier_table_of_fixed_width(tmp_path):
    lines = ["A          RA      Name   ", "           deg            ", "---------- ------- -------"]
    table = read(
        tmp_path / "v.txt", "\n".join(["#Title: x", *lines, "       1.5   150.1 a b", "             150.2 c"]) + "\n"
    )
    assert table.colnames == ["A", "RA", "Name"] and list(table["Name"]) == ["a b", "c"]
    assert table["RA"].unit == "deg" and list(table["A"].mask) == [False, True]


def test_the_first_of_several_vizier_tables_is_read_and_reported(tmp_path):
    table = read(tmp_path / "v.tsv", VIZIER + "#Name: II/999\n" + VIZIER.split("\n\n")[1])
    assert len(table) == 2
    assert table.meta["sameas_notes"] == [
        f"{tmp_path / 'v.tsv'} holds several tables of VizieR; used the first (II/246/out)"
    ]


def test_comments_in_another_encoding_do_no_harm(tmp_path):
    assert len(read(tmp_path / "v.tsv", VIZIER.replace("Cutri", "Åkesson"), "latin-1")) == 2
    assert len(read(tmp_path / "c.csv", "# Åkesson\nra,dec\n1,2\n", "latin-1")) == 1


@pytest.mark.parametrize("ending", [".tbl", ".ipac", ".txt", ".tbl.gz"])
def test_an_ipac_table(ending, tmp_path):
    table = read(tmp_path / f"i{ending}", IPAC)
    assert table.colnames == ["ra", "dec", "sigra", "name"] and table["sigra"].unit == "arcsec"
    assert list(table["sigra"].mask) == [False, True] and table.meta["EPOCH_OF"] == 2010.5


@pytest.mark.parametrize("ending", [".mrt", ".txt", ".dat.gz"])
def test_a_machine_readable_table(ending, tmp_path):
    table = read(tmp_path / f"m{ending}", MRT + MRT_ROWS)
    assert table.colnames == ["Name", "RAdeg", "DEdeg", "Vmag"] and table["RAdeg"].unit == "deg"
    assert list(table["Vmag"].mask) == [False, True] and "Ep=2016.0" in table["RAdeg"].description


@pytest.mark.parametrize("ending", ["", ".gz"])
def test_a_cds_table_with_its_readme(ending, tmp_path):
    other = MRT.partition("Byte-by-byte")[2].replace("table.dat", "other.dat").replace("RAdeg", "RBdeg")
    (tmp_path / "ReadMe").write_text(MRT + "Note\n\nByte-by-byte" + other)
    table = read(tmp_path / f"table.dat{ending}", MRT_ROWS)
    assert table.colnames == ["Name", "RAdeg", "DEdeg", "Vmag"] and table["DEdeg"][1] == 2.19292


@pytest.mark.parametrize("ending", [".txt", ".dat", ".asc", ".txt.gz", ".csv"])
def test_blank_separated_text(ending, tmp_path):
    table = read(tmp_path / f"b{ending}", BLANKS)
    assert table.colnames == ["id", "ra", "dec", "name"] and list(table["id"]) == [4472832130942575872, 2]
    assert list(table["ra"]) == [150.0279671, 150.0]
    quoted = read(tmp_path / f"q{ending}", 'name  ra  dec\r\n"a star" 1 2 \r\n\r\n# remark\r\n  b  --   nan\r\n')
    assert list(quoted["name"]) == ["a star", "b"] and quoted["ra"].mask[1] and np.isnan(quoted["dec"][1])


def test_malformed_blank_separated_text(tmp_path):
    with pytest.raises(InputError, match=r"line 1 holds numbers; put the names of the columns above"):
        read(tmp_path / "b.txt", "1 2 3\n4 5 6\n")
    with pytest.raises(InputError, match=r"line 4 has 2 cells, not 3"):
        read(tmp_path / "b.txt", "a b c\n1 2 3\n4 5 6\n7 8\n")


@pytest.mark.parametrize("text", ["name;ra;Größe\na;1;2\nÉtoile;3;4\n", "name;ra;n\na;1;2\nÉtoile;3;4\n"])
def test_csv_of_a_western_spreadsheet(text, tmp_path):
    table = read(tmp_path / "c.csv", text, "cp1252")
    assert list(table["name"]) == ["a", "Étoile"] and list(table["ra"]) == [1, 3]
    assert "is read as Windows-1252" in table.meta["sameas_notes"][0]


@pytest.mark.parametrize(
    "text", ["150.5 2.25\n10.0 -3.5\n", "# mine\n150.5, 2.25\n10.0, -3.5\n", "150.5\t2.25\r\n\r\n10.0\t-3.5"]
)
def test_a_list_of_positions_in_degrees_needs_no_names(text, tmp_path):
    table = read(tmp_path / "mine.txt", text)
    assert list(table["RA"]) == [150.5, 10.0] and list(table["DEC"]) == [2.25, -3.5]
    assert "have no names: they are read as right ascension" in table.meta["sameas_notes"][0]


@pytest.mark.parametrize("text", ["10:02:00.1 -00:15:00\n", "10 02 00.1 -00 15 00\n", "10h02m00.1s,-00d15m00s\n"])
def test_a_sexagesimal_list_of_positions_needs_no_names(text, tmp_path):
    table = read(tmp_path / "mine.txt", 2 * text)
    assert table.colnames == ["RA", "DEC"] and len(table) == 2 and str(table["DEC"][0]).startswith("-00")


def test_numbers_that_are_no_positions_need_names(tmp_path):
    for text in ("512.5 100.25\n3.0 4.0\n", "512 100\n3 4\n", "1 2 3\n4 5 6\n"):
        with pytest.raises(InputError, match="holds numbers; put the names of the columns above"):
            read(tmp_path / "pixels.txt", text)
    assert read(tmp_path / "named.txt", "# x y\n1 2\n3 4\n").colnames == ["x", "y"]


@pytest.mark.parametrize(
    "text",
    [
        "+----+-------+\n| id | ra    |\n+----+-------+\n|  1 | 10.25 |\n| b c|       |\n+----+-------+\n",
        "| id | ra    |\n|:---|------:|\n|  1 | 10.25 |\n| b c|       |\n",
    ],
)
def test_a_drawn_table(text, tmp_path):
    table = read(tmp_path / "drawn.txt", text)
    assert list(table["id"]) == ["1", "b c"] and table["ra"][0] == 10.25 and table["ra"].mask[1]


def test_a_column_whose_title_has_blanks_is_one_column(tmp_path):
    assert read(tmp_path / "c.csv", "RA (deg)\n1.5\n2.5\n").colnames == ["RA (deg)"]


@pytest.mark.parametrize("ending", [".cat", ".ldac", ".fits"])
def test_fits_ldac_gives_its_objects_and_the_time_of_its_image(ending, tmp_path):
    image = fits.Header()
    image["MJD-OBS"], image["EXPTIME"] = 58000.5, 30.0
    text = np.array([[card.ljust(80) for card in repr(image).split("\n")]], dtype="S80")
    form, dim = f"{80 * text.shape[1]}A", f"(80, {text.shape[1]})"
    head = fits.BinTableHDU.from_columns([fits.Column("Field Header Card", form, dim=dim, array=text)])
    head.name = "LDAC_IMHEAD"
    objects = fits.BinTableHDU.from_columns([fits.Column("ALPHA_J2000", "D", array=[1.0, 2.0], unit="deg")])
    objects.name = "LDAC_OBJECTS"
    fits.HDUList([fits.PrimaryHDU(), head, objects]).writeto(tmp_path / f"l{ending}")
    table = read_table(tmp_path / f"l{ending}")
    assert table.colnames == ["ALPHA_J2000"] and table.meta["MJD-OBS"] == 58000.5 and "sameas_notes" not in table.meta


def test_read_only_formats_are_not_written(tmp_path):
    assert set(known_formats()) - set(written_formats()) == {
        "daophot", "positions", "drawn", "sextractor", "ipac", "mrt", "vizier", "ascii",
    }  # fmt: skip
    with pytest.raises(InputError, match=r"the extension '.tbl' is not known; known are .fits"):
        write_table(Table({"x": [1]}), tmp_path / "t.tbl", provenance={})
    with pytest.raises(InputError, match=r"IPAC table is read, not written; give one of fits, votable"):
        write_table(Table({"x": [1]}), tmp_path / "t.tbl", provenance={}, format="ipac")


def test_a_file_of_another_extension_is_recognised_by_its_first_bytes(tmp_path):
    write_table(Table({"x": [1.0]}), tmp_path / "t.fits", provenance={})
    (tmp_path / "t.fits").rename(tmp_path / "t.cat2")
    assert read_table(tmp_path / "t.cat2").colnames == ["x"]
    (tmp_path / "catalogue").write_text(SEXTRACTOR)
    assert len(read_table(tmp_path / "catalogue")) == 2


@pytest.mark.parametrize("ending", [".csv", ".csv.gz", ".txt"])
def test_ecsv_under_another_name_is_read_as_ecsv(ending, tmp_path):
    """As the Gaia archive names its files, with "null" for what is not known."""
    import gzip

    text = "# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n"
    for name, kind, unit in (("source_id", "int64", ""), ("pmra", "float64", "mas.yr**-1")):
        text += f"# -\n#   name: {name}\n#   datatype: {kind}\n" + (f"#   unit: {unit}\n" if unit else "")
    text += "source_id,pmra\n4295806720000000001,null\n2,1.5\n"
    content = text.encode()
    (tmp_path / f"g{ending}").write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
    table = read_table(tmp_path / f"g{ending}")
    assert table["source_id"].tolist() == [4295806720000000001, 2] and table["pmra"].tolist() == [None, 1.5]
    assert table["pmra"].unit == "mas/yr"


@pytest.mark.parametrize("ending", ["", ".gz"])
@pytest.mark.parametrize("content", [SEXTRACTOR, VIZIER, IPAC, "name,ra\nÅ,1\nβ 𝛽,2\n"])
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "markless utf-16-be", "markless utf-16-le"])
def test_text_in_utf_16_is_read_as_that_in_utf_8(encoding, content, ending, tmp_path):
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    encoding = encoding.removeprefix("markless ")
    packed = gzip.compress if ending else bytes
    (tmp_path / f"wide.txt{ending}").write_bytes(packed((mark + content).encode(encoding)))
    (tmp_path / f"plain.txt{ending}").write_bytes(packed(content.encode()))
    wide, plain = (read_table(tmp_path / f"{name}.txt{ending}") for name in ("wide", "plain"))
    assert wide.colnames == plain.colnames and len(wide) == 2 and wide.pformat() == plain.pformat()


@pytest.mark.parametrize(
    "content",
    [
        'name,ra,dec,n\na,"150,125","-2,5",7\nb,"+150,25","2,125e0",\n',
        "name;ra;dec;n\na;150,125;-2,5;7\nb;150,25;2,125;\n",
    ],
)
def test_commas_within_numbers_are_decimal_points_where_none_has_a_point(content, tmp_path):
    """As spreadsheets write them in most of Europe."""
    (tmp_path / "t.csv").write_text(content)
    table = read_table(tmp_path / "t.csv")
    assert table["ra"].tolist() == [150.125, 150.25] and table["dec"].tolist() == [-2.5, 2.125]
    assert table["name"].tolist() == ["a", "b"] and table["n"].tolist() == [7, None]
    assert table.meta["sameas_notes"] == [f"{tmp_path / 't.csv'}: commas within numbers are read as decimal points"]


@pytest.mark.parametrize(
    "content", ['x,n\n1.5,"12,345"\n2.5,"1,5"\n', 'x,n\n1,"12,345"\n2,"1,500"\n', 'x,n\n1,"12,5"\n2,"1,5 m"\n']
)
def test_commas_that_may_separate_thousands_are_kept(content, tmp_path):
    (tmp_path / "t.csv").write_text(content)
    table = read_table(tmp_path / "t.csv")
    assert table["n"].dtype.kind == "U" and "sameas_notes" not in table.meta


def test_one_row_of_whole_columns_is_a_table(tmp_path):
    """As STILTS' colfits and structures of IDL are."""
    columns = [fits.Column("ID", "3J", array=[[1, 2, 3]]), fits.Column("RA", "3D", unit="deg", array=[[1.5, 2.5, 3.5]])]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "col.fits")
    table = read_table(tmp_path / "col.fits")
    assert table["ID"].tolist() == [1, 2, 3] and table["RA"].tolist() == [1.5, 2.5, 3.5] and table["RA"].unit == "deg"
    columns = [fits.Column("ID", "J", array=[1]), fits.Column("MAG", "3D", array=[[1.5, 2.5, 3.5]])]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "one.fits")
    assert read_table(tmp_path / "one.fits")["MAG"].shape == (1, 3)


@pytest.mark.parametrize(
    ("written", "unit"), [("degrees", None), ("Deg", None), ("deg", "deg"), ("mas.yr**-1", "mas / yr")]
)
def test_words_in_votable_are_no_units_of_their_own(written, unit, tmp_path):
    """Astropy makes a unit of any word there, which is an angle by its spelling only."""
    path = tmp_path / "t.vot"
    Table({"ra": [1.0]}).write(path, format="votable")
    path.write_text(path.read_text().replace('name="ra"', f'name="ra" unit="{written}"'))
    column = read_table(path)["ra"]
    if unit is None:
        assert isinstance(column.unit, UnrecognizedUnit) and str(column.unit) == written
    else:
        assert column.unit == unit
