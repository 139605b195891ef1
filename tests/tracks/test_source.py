"""Descriptions: given values are used, assumed ones listed on the page, invalid ones refused by name."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.kinds import KINDS
from sameas.tracks.source import (
    PARTS,
    BiasPrior,
    Description,
    KnownBiases,
    MissRate,
    SensorCoverage,
    SensorErrors,
    Site,
    read_descriptions,
)

TOML = """
[sources.harbour]
kind = "marine radar"
site = { lat_deg = 50.77, lon_deg = -1.30, height_m = 25 }
coverage = { range_m = 20000, sector_deg = [300, 120], shadows_deg = [[40, 55]] }
misses = { q = [0.05, 0.1, 0.5], range_m = [0, 10000, 20000] }
errors = { bearing_deg = 0.4 }

[sources.ais]
kind = "ais"
"""


def test_toml_and_python_descriptions_agree(tmp_path):
    path = tmp_path / "sources.toml"
    path.write_text(TOML)
    harbour, ais = read_descriptions(path)
    assert harbour == Description(
        "harbour", "marine radar", site=Site(50.77, -1.30, 25),
        coverage=SensorCoverage(20000, 0.0, (300, 120), ((40, 55),)),
        misses=MissRate((0.05, 0.1, 0.5), (0, 10000, 20000)), errors=SensorErrors(bearing_deg=0.4),
    )  # fmt: skip
    assert ais.name == "ais" and ais.errors.position_m == 15.0


def test_every_assumed_number_is_listed_with_its_reason():
    radar = Description("harbour", "marine radar", errors=SensorErrors(bearing_deg=0.4), misses=MissRate(0.3))
    assumed = {line.name: line for line in radar.assumed}
    assert "errors.bearing_deg" not in assumed and "misses.q" not in assumed
    assert set(assumed) | {"errors.bearing_deg", "misses.q"} == set(KINDS["marine radar"].defaults)
    assert str(assumed["errors.range_m"]) == (
        "harbour: errors.range_m = 15, assumed for marine radar: IMO MSC.192(79) allows 30 m, taken as 2σ"
    )


def test_the_split_probability_is_given_or_assumed():
    assert Description("camera", "camera").resolution.split == 0.1
    described = Description.from_mapping("camera", {"kind": "camera", "resolution": {"split": 0.3}})
    assert described.resolution.split == 0.3 and "resolution.split" not in {line.name for line in described.assumed}
    for wrong in (0.0, 1.0):
        with pytest.raises(InputError, match=f"camera: resolution: split is {wrong}; give a probability"):
            Description.from_mapping("camera", {"kind": "camera", "resolution": {"split": wrong}})


@pytest.mark.parametrize("kind", KINDS)
def test_defaults_of_every_kind_are_known_numbers_with_reasons(kind):
    for name, (value, why) in KINDS[kind].defaults.items():
        part, _, field = name.partition(".")
        assert hasattr(PARTS[part](), field) and np.isfinite(value) and len(why) > 3
    described = Description("one", kind)
    assert len(described.assumed) == len(KINDS[kind].defaults)


def test_misses_follow_the_range_and_are_certain_outside_the_coverage():
    radar = Description(
        "radar",
        coverage=SensorCoverage(20e3, 100.0, (300.0, 120.0), ((40.0, 55.0),)),
        misses=MissRate((0.1, 0.5), (0.0, 20e3)),
    )
    q = radar.q_at([10e3, 10e3, 10e3, 10e3, 30e3, 50.0], [0.0, 200.0, 50.0, 359.0, 0.0, 0.0])
    np.testing.assert_allclose(q, [0.3, 1.0, 1.0, 0.3, 1.0, 1.0])


def test_a_known_bias_is_estimated_only_if_its_uncertainty_is_given():
    known = Description("radar", "marine radar", calibration=KnownBiases(range_m=-35.0))
    assert known.bias.range_m is None and known.bias.azimuth_deg == 1.0
    assert "bias.range_m" not in {line.name for line in known.assumed}
    nearly = Description("radar", "marine radar", calibration=KnownBiases(range_m=-35.0), bias=BiasPrior(range_m=5.0))
    assert nearly.bias.range_m == 5.0
    shifted = Description("other", "tracks", calibration=KnownBiases(east_m=3.0))
    assert shifted.bias.shift_m is None and Description("other", "tracks").bias.shift_m == 50.0


def test_a_site_is_in_degrees_or_in_metres_and_fits_the_picture():
    pytest.importorskip("pymap3d")
    plane = LocalPlane(50.0, 0.0)
    assert Site(50.0, 0.0).in_plane(plane) == pytest.approx((0.0, 0.0))
    with pytest.raises(InputError, match="not those of the picture"):
        Site(50.0, 0.0).in_plane(None)
    with pytest.raises(InputError, match="give lat_deg and lon_deg, or east_m and north_m"):
        Site(50.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[sources.a]\nkind = "radr"', r"a: kind is 'radr'; give one of marine radar"),
        ("[sources.a]\nerrors = { bearing = 1 }", r"a: 'bearing' in errors is not known; did you mean bearing_deg\?"),
        ("[sources.a]\nerors = { bearing_deg = 1 }", r"a: 'erors' is not known; did you mean errors\?"),
        ("[sources.a]\nerrors = 3", r"a: errors is 3; give a table"),
        ("[sources.a]\nmisses = { q = 1.5 }", r"a: misses: q is 1.5; give probabilities"),
        ("[sources.a]\nmisses = { q = [0.1, 0.2] }", r"a: misses: 2 q for ranges \(\)"),
        ("[sources.a]\nerrors = { range_m = -3 }", r"a: errors.range_m is -3; give numbers of zero or more"),
        ('[sources.a]\nerrors = { range_m = "3" }', r"a: errors.range_m is '3'"),
        ("[sources.a]\ncoverage = { sector_deg = [10, 20, 30] }", r"a: coverage.sector_deg is .*give \(from, to\)"),
        ("[sources.a]\ncoverage = { shadows_deg = [10, 20] }", r"a: coverage.shadows_deg"),
        ("[radar]\nkind = 3", r"describes no sources; give tables such as \[sources.radar\]"),
        ("sources = { a = 3 }", r"sources.a is no table"),
        ("not toml", r"cannot be read as TOML"),
    ],
)
def test_mistakes_in_a_description_file_are_named(tmp_path, text, words):
    path = tmp_path / "sources.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_descriptions(path)


PAGE = (Path(__file__).parents[2] / "docs" / "sensors.md").read_text(encoding="utf-8")


def kinds_table():
    """Defaults in rows, kinds in columns, as on the page."""
    kinds = [name for name, kind in KINDS.items() if kind.defaults]
    names = list(dict.fromkeys(name for part in PARTS for kind in kinds for name in KINDS[kind].defaults
                               if name.startswith(f"{part}.")))  # fmt: skip
    lines = ["| | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for name in names:
        values = [KINDS[kind].defaults.get(name) for kind in kinds]
        lines.append(f"| `{name}` | " + " | ".join("" if v is None else f"{v[0]:g}" for v in values) + " |")
    return "\n".join(lines)


def test_the_defaults_of_all_kinds_are_on_the_page():
    assert kinds_table() in PAGE, f"put this into docs/sensors.md:\n{kinds_table()}"


def test_every_part_and_field_of_a_description_is_on_the_page():
    rows = {line.split("`")[1]: line for line in PAGE.splitlines() if line.startswith("| `")}
    for part, made in PARTS.items():
        for field in fields(made):
            assert f"`{field.name}`" in rows[part], f"{part}.{field.name} is not on the page"


def test_a_site_in_degrees_and_minutes_is_refused_with_the_form_to_give():
    site = {"lat_deg": "53°54'N", "lon_deg": 8.7}
    with pytest.raises(InputError, match=r"radar: site\.lat_deg is .*; give decimal degrees, south and west negative"):
        Description.from_mapping("radar", {"kind": "marine radar", "site": site})


@pytest.mark.parametrize(("given", "kind"), [("AIS", "ais"), ("ADSB", "ads-b"), ("Marine_Radar", "marine radar")])
def test_kinds_are_read_in_any_spelling(given, kind):
    assert Description.from_mapping("a", {"kind": given}).kind == kind
