"""Files of reports as real systems write them, each in a few rows."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest

from sameas.io.sensors import ReadOptions, read_reports

START_S = 1_714_560_000.0  # 2024-05-01 10:40


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


def stamp(k, form):
    return datetime.fromtimestamp(START_S + 10.0 * k, UTC).strftime(form)


def read(path, **options):
    [reports] = read_reports(path, ReadOptions(**options))
    return reports


def test_dates_that_look_like_numbers_are_dates(tmp_path):
    """The stamps of exactEarth were read as milliseconds since 1970: the year 2611."""
    for k, form in enumerate(("%Y%m%d_%H%M%S", "%Y%m%d%H%M%S", "%Y%m%dT%H%M%SZ", "%Y%m%d %H%M%S")):
        rows = "".join(f"366053209,1,{stamp(j, form)},{50.5 + 0.001 * j},-1.0,12.3,70.0\n" for j in range(3))
        path = written(tmp_path, f"ais{k}.csv", "MMSI,Message_ID,Time,Latitude,Longitude,SOG,COG\n" + rows)
        assert read(path).time_s.tolist() == [START_S, START_S + 10.0, START_S + 20.0]


def test_altitudes_of_flightaware_are_hundreds_of_feet(tmp_path):
    positions = [
        {"fa_flight_id": "DLH123-1", "altitude": 350, "groundspeed": 400, "heading": 70, "latitude": 50.5 + 0.01 * k,
         "longitude": -1.0, "timestamp": stamp(k, "%Y-%m-%dT%H:%M:%SZ")} for k in range(3)
    ]  # fmt: skip
    track = read(written(tmp_path, "track.json", json.dumps({"actual_distance": 100, "positions": positions})))
    assert track.alt_m == pytest.approx(35_000 * 0.3048) and track.track_id[0] == "DLH123-1"
    lines = [
        {"pitr": "1", "type": "position", "ident": "DLH123", "alt": "35000", "clock": f"{START_S + k:.0f}", "gs": "400",
         "hexid": "3C6675", "lat": f"{50.5 + 0.01 * k}", "lon": "-1.0"} for k in range(3)
    ]  # fmt: skip
    stream = read(written(tmp_path, "firehose.json", "".join(f"{json.dumps(line)}\n" for line in lines)))
    assert stream.alt_m == pytest.approx(35_000 * 0.3048) and stream.time_s[0] == START_S
    assert (stream.icao[0], stream.callsign[0]) == ("3c6675", "DLH123")


def test_the_height_of_remote_id_is_not_that_above_the_ground(tmp_path):
    """``Height`` counts from the ground or the place of take-off; it was taken before the altitude of the drone."""
    place = {"Latitude": 50.5, "Longitude": -1.0, "Height": 60.0, "Direction": 70.0, "SpeedHorizontal": 6.3}
    altitudes = {"AltitudeGeo": 120.0, "AltitudeBaro": 118.0}
    for more, expected in ((altitudes, 120.0), ({"HeightType": "AboveGround"}, None)):
        lines = [
            {"timestamp": stamp(k, "%Y-%m-%dT%H:%M:%SZ"), "BasicID": {"UASID": "1581F4X"}, "Location": place | more}
            for k in range(3)
        ]
        drone = read(written(tmp_path, "rid.json", "".join(f"{json.dumps(line)}\n" for line in lines)))
        assert (drone.alt_m is None) if expected is None else (drone.alt_m[0] == expected)
        assert drone.track_id[0] == "1581F4X" and drone.speed_m_per_s[0] == 6.3


def test_times_of_expedition_are_days_of_excel(tmp_path):
    rows = "".join(
        f"0,{(START_S + 10 * k) / 86400 + 25569:.9f},7.1,{50.5 + 0.001 * k},-1.0,70,12.3\n" for k in range(3)
    )
    own = read(written(tmp_path, "log.csv", "!Boat,Utc,BSP,Lat,Lon,COG,SOG\n!v12.1.3\n" + rows))
    np.testing.assert_allclose(own.time_s, START_S + 10.0 * np.arange(3.0), atol=1e-3)


@pytest.mark.parametrize(
    ("step", "speed", "tracked", "is_ms"),
    [(100, 5.0, True, True), (100, 5.0, False, True), (10, 5.0, True, True), (1, 5.0, True, False),
     (10, 5000.0, True, False), (3, 5.0, False, False), (30, 5.0, False, False)],
)  # fmt: skip
def test_milliseconds_without_a_unit_are_known_by_their_steps_and_the_motion(tmp_path, step, speed, tracked, is_ms):
    """A lidar with ten scans a second in milliseconds gave one in 100 s; a radar with one in 3 s gives seconds."""
    rows = "".join(f"{step * k},{'7' if tracked else ''},{speed * step / 1000 * k:.3f},2\n" for k in range(200))
    reports = read(written(tmp_path, "lidar.csv", "t,id,x,y\n".replace("id", "id" if tracked else "note") + rows))
    assert np.diff(reports.time_s)[0] == pytest.approx(step / 1000.0 if is_ms else step)
    assert any("milliseconds" in note for note in reports.notes) == is_ms
    # What a name or the user says counts.
    said = read(tmp_path / "lidar.csv", units={"t": "s"})
    assert np.diff(said.time_s)[0] == step
