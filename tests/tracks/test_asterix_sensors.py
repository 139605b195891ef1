"""Sensors in ASTERIX are known by SAC and SIC: names, places, recordings in parts, data sources of COMPASS."""

import json

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import read_source_options, read_sources
from sameas.io.sensors.stream import ReportStream
from sameas.picture.live import LivePicture
from sameas.tracks.source import Description

DATE, DAY = 1714521600.0, "2024-05-01"  # 2024-05-01
WIEN = (48.2345, 16.3717, 187.0)


def block(category, data):
    return bytes([category]) + (len(data) + 3).to_bytes(2, "big") + data


def plot(seconds, sic=12, sac=80):
    """A plot at 10 NM, north east: items 010, 140, 040."""
    tod = int(seconds * 128).to_bytes(3, "big")
    return block(48, bytes([0xD0, sac, sic]) + tod + (2560).to_bytes(2, "big") + b"\x20\0")


def service(place=WIEN, sic=12, sac=80):
    """A service message with items 010 and 120."""
    lat, lon, height_m = place
    degrees = b"".join(round(angle / 180 * 2**23).to_bytes(3, "big", signed=True) for angle in (lat, lon))
    return block(34, bytes([0x81, 0x10, sac, sic]) + int(height_m).to_bytes(2, "big") + degrees)


@pytest.fixture
def recording(tmp_path):
    file = tmp_path / "night.ast"
    file.write_bytes(b"".join(plot(60.0 + 4 * k) + plot(61.0 + 4 * k, 13) for k in range(5)) + service())
    return file


def test_a_radar_stands_where_its_messages_say(recording):
    wien, other = read_sources([recording], start=DAY)
    site = wien.description.site
    assert (site.lat_deg, site.lon_deg, site.height_m) == pytest.approx(WIEN, abs=2e-5)
    assert any("its place is that of its service messages: 48.23451°, 16.3717" in line for line in wien.lines())
    assert wien.description.kind == "air radar" and other.description.site is None


def test_a_description_may_name_a_sensor_by_its_codes(recording, tmp_path):
    toml = tmp_path / "sensors.toml"
    toml.write_text(
        '[sources.wien]\nsac_sic = "80/12"\nerrors = { bearing_deg = 0.1 }\n'
        '[sources.other]\nsac_sic = "80/13"\nkind = "air radar"\nsite = { lat_deg = 47, lon_deg = 16 }\n'
    )
    wien, other = read_sources([recording], read_source_options(toml), start=DAY)
    assert [one.description.name for one in (wien, other)] == ["wien", "other"] == [wien.reports.source, "other"]
    assert wien.description.errors.bearing_deg == 0.1 and wien.description.site.height_m == 187.0
    assert other.description.site.lat_deg == 47.0
    toml.write_text('[sources.wien]\nsac_sic = "80"\n')
    with pytest.raises(InputError, match=r"sources.wien.sac_sic is '80'; give SAC and SIC, such as \"80/12\""):
        read_source_options(toml)
    toml.write_text('[sources.graz]\nsac_sic = "80/14"\n')
    with pytest.raises(InputError, match=r"graz is described, but no file belongs to it; there are night:048 80/12"):
        read_sources([recording], read_source_options(toml), start=DAY)


def test_a_given_site_far_from_the_stated_one_is_kept_and_said(recording, tmp_path):
    toml = tmp_path / "sensors.toml"
    toml.write_text('[sources.wien]\nsac_sic = "80/12"\nsite = { lat_deg = 48.3345, lon_deg = 16.3717 }\n')
    wien = read_sources([recording], read_source_options(toml), start=DAY)[0]
    assert wien.description.site.lat_deg == 48.3345
    assert any("wien: the given site is 11.1 km from that of its service messages" in one for one in wien.lines())


def test_recordings_of_one_sensor_that_follow_each_other_are_one_source(tmp_path):
    for hour in range(3):
        content = [plot(3600 * hour + 4 * k) + plot(3600 * hour + 4 * k + 1, 13) for k in range(5)]
        (tmp_path / f"{hour:02d}.ast").write_bytes(b"".join(content) + (service() if hour == 1 else b""))
    files = sorted(tmp_path.glob("*.ast"))
    wien, other = read_sources(files, start=DAY)
    assert [one.description.name for one in (wien, other)] == ["048 80/12", "048 80/13"]
    assert len(wien.reports) == len(other.reports) == 15
    assert wien.description.site.height_m == 187.0 and wien.path.name == "00.ast, 01.ast, 02.ast"
    assert np.all(np.diff(wien.reports.time_s) > 0)
    # Two recordings of the same hour, as of two networks, stay apart.
    again = tmp_path / "again.ast"
    again.write_bytes(files[0].read_bytes())
    assert len(read_sources([files[0], again], start=DAY)) == 4


CURRENT = {
    "content_type": "data_sources", "content_version": "0.2",
    "data_sources": [
        {"ds_type": "Radar", "name": "Wien Süd", "short_name": "WS", "sac": 80, "sic": 12, "info": {
            "position": {"latitude": 48.2345, "longitude": 16.3717, "altitude": 187.0},
            "radar_accuracy": {"primary_range_stddev": 120.0, "primary_azimuth_stddev": 0.05,
                               "secondary_range_stddev": 70.0, "secondary_azimuth_stddev": 0.025},
            "radar_range": {"primary_ir_max": 60.0, "secondary_ir_max": 150.0}}},
        {"ds_type": "Radar", "name": "Graz", "sac": 80, "sic": 13, "info": {}},
        {"ds_type": "Tracker", "name": "ARTAS", "sac": 80, "sic": 100},
        {"ds_type": "ADSB", "name": "Ground stations", "sac": 80, "sic": 200},
    ],
}  # fmt: skip
OLDER = {
    "Radar": [
        {"dbo_name": "Radar", "name": "Wien Süd", "short_name": "WS", "sac": 80, "sic": 12, "latitude": 48.2345,
         "longitude": 16.3717, "altitude": 187.0, "secondary_range_stddev": 70.0, "secondary_azimuth_stddev": 0.025,
         "secondary_ir_max": 150.0},
        {"dbo_name": "Radar", "name": "Graz", "sac": 80, "sic": 13},
    ],
    "Tracker": [{"dbo_name": "Tracker", "name": "ARTAS", "sac": 80, "sic": 100}],
}  # fmt: skip


@pytest.mark.parametrize("content", [CURRENT, OLDER])
def test_data_sources_of_compass_describe_the_sensors(recording, tmp_path, content):
    (tmp_path / "sources.json").write_text(json.dumps(content))
    options = read_source_options(tmp_path / "sources.json")
    assert options["ARTAS"].description.kind == "tracks"
    # The list has sensors that the recording does not have.
    wien, graz = read_sources([recording], options, start=DAY)
    assert [one.description.name for one in (wien, graz)] == ["WS", "Graz"]
    assert wien.description.kind == graz.description.kind == "air radar" and wien.why_kind is None
    assert (wien.description.site.lat_deg, wien.description.site.height_m) == (48.2345, 187.0)
    assert (wien.description.errors.range_m, wien.description.errors.bearing_deg) == (70.0, 0.025)
    assert wien.description.coverage.range_m == 150 * 1852.0 and graz.description.site is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "cannot be read as JSON"),
        ("{}", "is JSON without data sources; export them from COMPASS"),
        (
            '{"data_sources": [{"ds_type": "Radar", "name": "Wien", "sac": 80}]}',
            "a data source has no name, SAC or SIC",
        ),
        (
            '{"data_sources": [{"name": "A", "sac": 1, "sic": 2}, {"name": "A", "sac": 1, "sic": 3}]}',
            "two data sources",
        ),
    ],
)
def test_other_json_is_refused(tmp_path, content, words):
    (tmp_path / "sources.json").write_text(content)
    with pytest.raises(InputError, match=words):
        read_source_options(tmp_path / "sources.json")


def test_live_a_radar_is_placed_by_its_service_messages():
    stream = ReportStream("air")
    picture = LivePicture([Description("wien", "air radar")])
    stream.feed(plot(60.0), DATE + 60.0, last=True)
    [first] = stream.reports()
    with pytest.raises(InputError, match="the sensor's position is not known"):
        picture.add("wien", first)
    stream.feed(service(), DATE + 61.0, last=True)
    assert stream.reports() == []
    for k in range(1, 6):
        stream.feed(plot(60.0 + 4 * k), DATE + 60.5 + 4 * k, last=True)
        picture.add("wien", *stream.reports())
    [description] = picture.descriptions
    assert description.site.height_m == 187.0 and picture.plane.lat_deg == pytest.approx(48.2345, abs=2e-5)
    assert picture.counts["wien"].taken == 5
