"""ADES and 80-column reports for the Minor Planet Center."""

import math
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from sameas import InputError
from sameas.io.ades import Observation, Observer, line_of, write_80_columns, write_psv, write_xml

HEADER = """[observatory]
mpcCode = "810"
[submitter]
name = "J. Doe"
[telescope]
design = "Schmidt-Cassegrain"
aperture = "0.36"
detector = "CCD"
[report]
astCat = "Gaia3"
band = "G"
"""


@pytest.fixture
def observer(tmp_path):
    path = tmp_path / "who.toml"
    path.write_text(HEADER)
    return Observer.read(path)


def rows():
    first = Observation("sa00001", "2018-10-18T03:03:53.784", 62.5, -0.5, 0.1, 0.12, 0.03, 17.23, 0.05, 30.0, "2713")
    other = Observation("sa00002", "2018-10-18T03:03:53.784", 359.9999999, 89.5, 0.1, 0.12, -0.5)
    return [first, other]


def test_extreme_values_stay_within_what_ades_allows(observer):
    """A long trail, and a bright star with errors of nothing: 1.000 and 0.000 are refused by the schema."""
    extreme = replace(rows()[0], correlation=-0.9999, rms_east=1e-5, magnitude_error=0.0, snr=math.inf)
    written = extreme.fields(observer)
    assert (written["rmsCorr"], written["rmsRA"], written["rmsMag"]) == ("-0.999", "0.001", "0.001")
    assert "logSNR" not in written


def test_what_may_be_rejected_is_doubted(observer):
    assert observer.doubts == ()
    unlisted, no_band = replace(observer, catalogue="GaiaDR3", band="").doubts
    assert "'GaiaDR3' is none of the names of catalogues" in unlisted and "no magnitudes" in no_band


def test_reports_are_valid(observer, tmp_path, monkeypatch):
    pytest.importorskip("ades", reason="iau-ades, which validates reports, is not installed")
    from ades.psvtoxml import psvtoxml
    from ades.valsubmit import valsubmit

    monkeypatch.chdir(tmp_path)
    write_psv(rows(), observer, "a.psv", software="sameas")
    write_xml(rows(), observer, "b.xml", software="sameas")
    psvtoxml("a.psv", "a.xml")
    for name in ("a.xml", "b.xml"):
        valsubmit(name)
        assert "submit is OK" in (tmp_path / "valsubmit.file").read_text()


def test_a_report_contains_known_values_only(observer, tmp_path):
    write_psv(rows(), observer, tmp_path / "a.psv", software="sameas")
    lines = (tmp_path / "a.psv").read_text().splitlines()
    assert lines[0] == "# version=2022" and "! mpcCode 810" in lines
    head, one, two = ([cell.strip() for cell in line.split("|")] for line in lines[-3:])
    first, second = dict(zip(head, one, strict=False)), dict(zip(head, two, strict=False))
    assert head[0] == "permID" and first["permID"] == "2713" and second["permID"] == ""
    assert first["mag"] == "17.23" and first["band"] == "G" and second.get("mag", "") == ""
    assert first["obsTime"] == "2018-10-18T03:03:53.784Z" and first["rmsCorr"] == "0.030"


def test_no_name_breaks_a_line_or_a_report(tmp_path):
    """Names of a header, of orbits and of tracklets: text in the one row or element that they belong to."""
    name = 'a|b\nprovID|\x1b[31m</trkSub><script>&"\u2028'
    observer = Observer("810", name, (name,), (name,), (("design", name),), "Gaia3", comments=(name,))
    every = [replace(one, name=name, provisional=name, remarks=name) for one in rows()]
    paths = [tmp_path / name for name in ("r.psv", "r.xml", "r.txt")]
    for write, path in zip((write_psv, write_xml, write_80_columns), paths, strict=True):
        write(every, observer, path, software="sameas")
        assert all(line.isprintable() for line in path.read_text(encoding="utf-8").split("\n"))
    psv = paths[0].read_text(encoding="utf-8").split("\n")
    assert len({line.count("|") for line in psv if line and line[0] not in "#!"}) == 1
    assert len(psv) - 1 == sum(line[0] in "#!" for line in psv if line) + 1 + len(every)
    optical = ElementTree.parse(paths[1]).getroot().findall("obsBlock/obsData/optical")
    assert [one.find("trkSub").text for one in optical] == ['a/b provID/ [31m</trkSub><script>&" '] * 2
    assert len(paths[2].read_text(encoding="utf-8").split("\n")) - 1 == 5 + len(every)


def test_lines_have_80_columns_and_round_up_correctly(observer, tmp_path):
    lines = [line_of(one, observer) for one in rows()]
    assert [len(line) for line in lines] == [80, 80]
    assert lines[0].startswith("02713") and "-00 30 00.00" in lines[0] and lines[0].endswith("810")
    assert lines[1][5:12] == "sa00002" and lines[1][32:44] == "00 00 00.000"
    write_80_columns(rows(), observer, tmp_path / "a.txt", software="sameas")
    assert (tmp_path / "a.txt").read_text().startswith("COD 810\n")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('mpcCode = "810"', 'mpcCode = "nowhere"'), "is not a code of the Minor Planet Center"),
        (('detector = "CCD"', ""), "says no telescope.detector"),
        (('astCat = "Gaia3"', ""), "says no report.astCat"),
        (("[submitter]", "[submitter"), "is not TOML"),
        (('"Gaia3"', '"Gaia DR3"'), "report.astCat is 'Gaia DR3', which ADES does not allow; give the Minor Planet"),
        (('band = "G"', 'band = "Gaia_G"'), "report.band is 'Gaia_G', which ADES does not allow"),
        (
            ('"0.36"', '"36 cm"'),
            "telescope.aperture is '36 cm', which ADES does not allow; give a number, without unit",
        ),
    ],
)
def test_an_incomplete_header_is_refused(change, words, tmp_path):
    path = tmp_path / "who.toml"
    path.write_text(HEADER.replace(*change))
    with pytest.raises(InputError, match=words):
        Observer.read(path)


def test_all_that_a_header_lacks_is_named_at_once(tmp_path):
    path = tmp_path / "who.toml"
    with pytest.raises(
        InputError, match=r'cannot be read .*; write, each key in a line: below \[observatory\] mpcCode = "810"'
    ):
        Observer.read(path)
    path.write_text("[telescope]\ndesign = 'Refractor'\n[submitter]\nname = 'J. Doe'\n")
    words = (
        r"says no observatory.mpcCode, telescope.aperture, telescope.detector, report.astCat; .*: below \[observatory\]"
    )
    with pytest.raises(InputError, match=words):
        Observer.read(path)


def test_magnitudes_need_a_band(observer):
    from dataclasses import replace

    assert "mag" not in rows()[0].fields(replace(observer, band="")) and math.isnan(rows()[1].magnitude)


def test_lines_of_80_columns_name_catalogues_and_high_numbers_as_the_minor_planet_center_does():
    """Codes as in iau-ades 0.1.3. Gaia DR3 and EDR3 were exchanged, three were wrong, and high numbers were lost."""
    one = Observation("sa00001", "2018-10-18T03:03:53.784", 62.5, 22.5, 0.1, 0.1, 0.0, permanent="433123")
    codes = {
        "Gaia3": "W",
        "Gaia3E": "X",
        "Gaia2": "V",
        "Hip2": "x",
        "Tyc1": "f",
        "Tyc2": "g",
        "UCAC3": "u",
        "UCAC4": "q",
    }
    for name, code in codes.items():
        line = line_of(one, Observer("810", "J. Doe", (), (), (), name))
        assert line[71] == code and line[:12] == "h3123       " and line[77:80] == "810" and len(line) == 80
