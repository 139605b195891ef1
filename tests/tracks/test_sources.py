"""Sensor files are paired with their descriptions; missing descriptions are inferred from the file."""

import pytest

from sameas.errors import InputError
from sameas.io.sensors.sources import read_source_options, read_sources

PLOTS = "time,range_km,bearing\n2024-05-01T12:00:00Z,5.2,40\n2024-05-01T12:00:03Z,5.1,41\n"
FIXES = "time,lat,lon,sog,mmsi\n2024-05-01T12:00:00Z,50.1,-1.2,10,235070762\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "plots.csv").write_text(PLOTS)
    (tmp_path / "coast.csv").write_text(FIXES)
    return tmp_path


def test_kinds_are_recognised_by_name_and_columns(folder):
    (folder / "harbour radar.csv").write_text(PLOTS)
    (folder / "unknown.csv").write_text("time,lat,lon\n2024-05-01T12:00:00Z,50.1,-1.2\n")
    radar, coast, plots = read_sources([folder / name for name in ("harbour radar.csv", "coast.csv", "plots.csv")])
    assert [s.description.kind for s in (radar, coast, plots)] == ["marine radar", "ais", "marine radar"]
    assert "read as ais: it has a column of mmsi" in coast.lines()[0]
    with pytest.raises(InputError, match=r"unknown: what kind of sensor is it\?.*\[sources.unknown\]"):
        read_sources([folder / "unknown.csv"])


def test_a_description_names_its_file_and_how_to_read_it(folder):
    (folder / "odd.csv").write_text("t,d,theta\n00:00:00,5.2,40\n00:00:03,5.1,41\n")
    (folder / "sensors.toml").write_text(
        '[sources.west]\nkind = "marine radar"\nsite = { lat_deg = 50, lon_deg = -1 }\n'
        'file = { path = "odd.csv", start = "2024-05-01", columns = { time_s = "t", range_m = "d", '
        'bearing_deg = "theta" }, units = { d = "km" } }\n'
    )
    [west] = read_sources([], read_source_options(folder / "sensors.toml"))
    assert west.description.name == west.reports.source == "west" and west.why_kind is None
    assert west.reports.range_m.tolist() == [5200.0, 5100.0] and west.reports.time_s[0] == 1714521600.0


def test_a_description_may_leave_the_kind_to_the_file(folder):
    (folder / "s.toml").write_text(
        '[sources.plots]\nsite = { lat_deg = 50, lon_deg = -1 }\nfile = { path = "plots.csv", start = 2024-05-01 }\n'
        '[sources.coast]\nkind = "other"\nfile = "coast.csv"\n'
    )
    plots, coast = read_sources([], read_source_options(folder / "s.toml"))
    assert (plots.description.kind, plots.why_kind) == ("marine radar", "it has a column of range_m")
    assert plots.description.site.lat_deg == 50 and plots.description.errors.bearing_deg == 0.5
    assert (coast.description.kind, coast.why_kind) == ("other", None)


def test_names_may_be_given_with_the_file(folder):
    toml = folder / "s.toml"
    toml.write_text('[sources.west]\nkind = "marine radar"\n')
    [west] = read_sources([f"west={folder / 'plots.csv'}"], read_source_options(toml))
    assert west.description.name == "west" and not any(a.source != "west" for a in west.description.assumed)
    with pytest.raises(InputError, match="west is described, but no file belongs to it; there are plots: give"):
        read_sources([folder / "plots.csv"], read_source_options(toml))
    with pytest.raises(InputError, match="two sources are called west; name them"):
        read_sources([f"west={folder / 'plots.csv'}", f"west={folder / 'coast.csv'}"])
    with pytest.raises(InputError, match="no files"):
        read_sources([])


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("[sources]\nwest = 3\n", r"sources.west is no table"),
        ('[sources.west]\nkind = "ais"\nfile = { colums = {} }\n', "'colums' is not known; give path, format"),
        ("[sources.west\n", "cannot be read as TOML"),
        ("x = 1\n", "describes no sources"),
    ],
)
def test_errors_of_a_description_are_reported(tmp_path, toml, message):
    (tmp_path / "s.toml").write_text(toml)
    with pytest.raises(InputError, match=message):
        read_source_options(tmp_path / "s.toml")


def test_a_log_of_two_sensors_gives_two_sources():
    from pathlib import Path

    log = Path(__file__).parent / "data" / "ais_sample.nmea"
    ais = read_sources([log], start="2024-05-01")
    assert [s.description.kind for s in ais] == ["ais"]


def test_a_format_named_like_a_kind_of_source_has_that_kind(folder, monkeypatch):
    """So a new sensor needs no table of formats and kinds."""
    from sameas.io.sensors import sources
    from sameas.io.sensors.format import SensorFormat
    from sameas.tracks.kinds import KINDS, Kind
    from sameas.tracks.reports import Reports

    def read(file):
        time_s, x_m, y_m = zip(*(map(float, line.split()) for line in file.lines[1:]), strict=True)
        return [Reports.of(file.source, "sonar", {"time_s": time_s, "x_m": x_m, "y_m": y_m})]

    sonar = SensorFormat("sonar", "sonar pings", read, lambda file: file.head_lines[0] == "SONAR")
    monkeypatch.setattr(sources, "FORMATS", (sonar, *sources.FORMATS))
    monkeypatch.setitem(KINDS, "sonar", Kind("a sonar", {"errors.position_m": (20.0, "a test")}))
    (folder / "pings.txt").write_text("SONAR\n0 10 20\n5 12 22\n")
    [pings] = read_sources([folder / "pings.txt"])
    assert (pings.description.kind, pings.why_kind) == ("sonar", "its format is sonar")
    assert pings.description.errors.position_m == 20.0


@pytest.mark.parametrize(
    "given",
    [
        'columns = { range_m = "Range" }',
        'columns = { range = "d" }',
        'columns = { range_m = "d" }, units = { d = "furlong" }',
    ],
)
def test_a_description_that_does_not_fit_its_file_is_an_error_where_others_can_be_read(given, tmp_path):
    (tmp_path / "ais.csv").write_text("time,lat,lon,mmsi\n0,50.0,-1.0,235000001\n")
    (tmp_path / "radar.csv").write_text("time,d,bearing\n0,900,45\n")
    (tmp_path / "sensors.toml").write_text(
        f'[sources.radar]\nkind = "marine radar"\nfile = {{ path = "radar.csv", {given} }}\n'
    )
    with pytest.raises(InputError, match=r"radar: .*(among: time, d, bearing|did you mean range_m|unit 'furlong')"):
        read_sources([tmp_path / "ais.csv"], read_source_options(tmp_path / "sensors.toml"), set_aside=[])
