"""Names from files stay text: on the terminal, in headers, regions, maps and tables; no text is executed."""

import ast
import json
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.units import UnrecognizedUnit
from astropy.utils import minversion
from typer.testing import CliRunner

import sameas
from sameas.cli.app import app
from sameas.io import read_provenance, read_table, write_table
from sameas.io.geojson import write_geojson
from sameas.io.plate import write_regions

SOURCE = Path(sameas.__file__).parent
HOSTILE = [
    "<script>alert(1)</script>", "</script><script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{data}}",
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "=cmd()", "+1+1", "@SUM(A1)", "../../etc/passwd", "a\nEND", "a\r\nb",
    "} point(0,0) # text={x", "a;b", "a'b\"c", "\u202eabc", "\ufeff", "% s %n", "", "x" * 300,
]  # fmt: skip


def stars(names):
    n = len(names)
    return Table({"name": names, "ra": 10.0 + 0.01 * np.arange(n), "dec": np.zeros(n), "sigma": np.full(n, 0.1)})


@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
def test_cells_round_trip(ending, tmp_path):
    # Formulas too: what a spreadsheet makes of a cell is said in the documents, not changed here.
    names = [name for name in HOSTILE if name.isascii() or ending != ".fits"]
    # XML has no control characters, and it and CSV know one line end only.
    names = [name for name in names if ending != ".vot" or not re.search(r"[\x00-\x08\x0b-\x1f]", name)]
    if ending == ".ecsv" and not minversion("astropy", "7.2"):
        names = [name for name in names if "\r" not in name]  # earlier ones read every end of a line as a line feed
    write_table(stars(names), tmp_path / f"t{ending}", provenance={"command": HOSTILE[4], "names": HOSTILE[:3]})
    back = np.ma.filled(read_table(tmp_path / f"t{ending}")["name"], "").tolist()
    assert back == names


CONTROLS = ["a\nEND\r\n--", "a\nb", "a\rb", "a\tb", "a\x00b", "\x1b[31mred\x1b]0;t\x07", "\x85z", "\u2028y", "\ufffez"]


@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
def test_column_names_are_one_line_and_their_tables_round_trip(ending, tmp_path):
    given = ["ra", "dec", *CONTROLS, "a  END  --", "a b", *HOSTILE[:3], HOSTILE[8]]
    write_table(Table([[float(k)] for k in range(len(given))], names=given), tmp_path / f"t{ending}", provenance={})
    back = read_table(tmp_path / f"t{ending}")
    assert [float(back[name][0]) for name in back.colnames] == list(range(len(given)))
    assert all(name.isprintable() for name in back.colnames) and back.colnames[:2] + back.colnames[-4:] == [
        "ra", "dec", *HOSTILE[:3], HOSTILE[8],
    ]  # fmt: skip


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
@pytest.mark.parametrize("text", CONTROLS)
def test_column_descriptions_never_make_a_table_unreadable(text, ending, tmp_path):
    table = stars(["a"])
    table.meta["key"], table["name"].description = text, text
    table["ra"].unit = UnrecognizedUnit(text)
    write_table(table, tmp_path / f"t{ending}", provenance={"fact": text})
    back = read_table(tmp_path / f"t{ending}")
    assert back["name"].tolist() == ["a"] and read_provenance(tmp_path / f"t{ending}") == {"fact": text}
    if ending == ".ecsv":
        assert back.meta["key"] == back["name"].description == text


def test_an_ecsv_header_with_an_empty_line_is_read(tmp_path):
    table = stars(["a"])
    table.meta["key"] = "a\nb"
    table.write(tmp_path / "t.ecsv", format="ascii.ecsv")  # astropy's own writer makes one
    assert "\n# \n" in (tmp_path / "t.ecsv").read_text() and read_table(tmp_path / "t.ecsv")["name"].tolist() == ["a"]


def test_fits_headers_contain_printable_ascii_only(tmp_path):
    table = stars(["a"])
    table.meta = {f"KEY{k}": text for k, text in enumerate(HOSTILE)} | {"comments": HOSTILE, "HISTORY": HOSTILE}
    table["name"].description = HOSTILE[10]
    for k, text in enumerate(HOSTILE[:-1]):
        table[f"{text}{k}"] = [1.0]
    write_table(table, tmp_path / "t.fits", provenance={f"fact {k}": text for k, text in enumerate(HOSTILE)})
    with fits.open(tmp_path / "t.fits") as hdus:
        text = hdus[1].header.tostring()
        assert all(" " <= letter <= "~" for letter in text) and len(text) % 2880 == 0
        assert hdus[1].header["TFIELDS"] == len(table.colnames)
    assert len(read_table(tmp_path / "t.fits")) == 1


def test_a_region_is_one_line_for_any_star_name(tmp_path):
    n = len(HOSTILE)
    listing = Table({
        "ra_deg": np.full(n, 10.0), "dec_deg": np.zeros(n), "star": HOSTILE, "remark": HOSTILE[::-1],
        "fate": [("identified", "unidentified", "missing")[k % 3] for k in range(n)], "p_match": np.full(n, 0.5),
        "p_none": np.full(n, 0.5), "measurement": np.arange(n),
    })  # fmt: skip
    write_regions(listing, tmp_path / "r.reg", radius_arcsec=2.0)
    lines = (tmp_path / "r.reg").read_text(encoding="utf-8").split("\n")[3:-1]
    assert len(lines) == n
    for line in lines:
        assert line.isprintable() and re.fullmatch(
            r"(circle|box|point)\([^()]*\) # [^{}]*(tag=\{[^{};]*\} ?){2}", line
        ), line


def test_geojson_is_valid_for_any_names(tmp_path):
    n = len(HOSTILE)
    objects = {"time_s": np.zeros(n), "object": np.arange(n), "lat_deg": np.zeros(n), "lon_deg": np.arange(n) + 0.0,
               "name": np.array(HOSTILE, object)}  # fmt: skip
    write_geojson(objects, tmp_path / "o.geojson")
    features = json.loads((tmp_path / "o.geojson").read_text(encoding="utf-8"))["features"]
    assert [feature["properties"].get("name") for feature in features[:n]] == HOSTILE


@pytest.mark.parametrize("name", ["\x1b[31m<b>", "=cmd()", "a\nb", "{{x}} \u202e"])
def test_the_terminal_shows_names_escaped(name, tmp_path):
    path = tmp_path / f"{name}.csv"
    path.write_text("ra,dec,mag\n10,\x1b[31mbad,1\n", encoding="utf-8")
    for arguments in ([str(path), str(path)], [str(path), str(tmp_path / f"no {name}.csv")]):
        result = CliRunner().invoke(app, ["match", *arguments, "-o", str(tmp_path / "o.fits")])
        assert result.exit_code == 1 and all(line.isprintable() for line in result.output.split("\n"))
    assert not (tmp_path / "o.fits").exists()


def calls(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), {word.arg: word.value for word in node.keywords}


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_the_source_calls_no_eval_exec_or_pickle(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = {
        alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names
    }
    imported |= {(node.module or "").split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    # Saved states are read there, and make data only (tests/io/test_io_saved.py).
    allowed = {"pickle"} if path.relative_to(SOURCE).as_posix() == "io/saved.py" else set()
    assert not imported & {"pickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"} - allowed
    for name, words in calls(tree):
        assert name not in ("eval", "exec", "compile", "__import__", "os.system", "os.popen", "yaml.load"), name
        assert "shell" not in words and "allow_pickle" not in words, name
