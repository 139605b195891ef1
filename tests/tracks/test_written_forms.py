"""Files of reports as real systems write them, each in a few rows."""

import json
import struct
import zipfile
from datetime import UTC, datetime, timedelta

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from sameas.errors import InputError
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


@pytest.mark.parametrize("first", [25569.0, 719529.0])
def test_days_of_excel_and_matlab_are_known_by_their_steps(tmp_path, first):
    rows = "".join(f"{(START_S + 2.5 * k) / 86400 + first:.9f},{1000 + k},70\n" for k in range(30))
    radar = read(written(tmp_path, "radar.csv", "time,range_m,brg\n" + rows))
    np.testing.assert_allclose(radar.time_s, START_S + 2.5 * np.arange(30.0), atol=1e-3)
    seconds = read(written(tmp_path, "other.csv", "t_s,range_m,brg\n" + rows))
    assert seconds.time_s[0] == pytest.approx(START_S / 86400 + first)


@pytest.mark.parametrize("form", ["%d-%b-%Y %H:%M:%S", "%d-%B-%Y %I:%M:%S %p", "%m/%d/%Y %I:%M:%S %p"])
def test_names_of_months_and_hours_of_twelve_are_read(tmp_path, form):
    times = [datetime(2024, 5, 14, 11, 59, 50, tzinfo=UTC) + timedelta(seconds=5 * k) for k in range(4)]
    rows = "".join(f"{time.strftime(form)},1000,70\n" for time in times)
    radar = read(written(tmp_path, "radar.csv", "time,range_m,brg\n" + rows))
    assert radar.time_s.tolist() == [time.timestamp() for time in times]


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


AIS_NAMES = "mmsi,base_date_time,longitude,latitude,sog,cog"


def ais_rows(n=12):
    return [(366053209, stamp(k, "%Y-%m-%d %H:%M:%S"), -1.0, 50.5 + 0.001 * k, 12.3, 70.0) for k in range(n)]


def ais_csv():
    return f"{AIS_NAMES}\n" + "".join(",".join(map(str, row)) + "\n" for row in ais_rows())


def test_files_packed_with_zstandard_and_zip_are_read(tmp_path):
    """MarineCadastre has files of each day, in zip until 2024 and in Zstandard since."""
    packed = pa.compress(ais_csv().encode(), "zstd", asbytes=True)
    (tmp_path / "ais.csv.zst").write_bytes(packed)
    for name, members in (("ais.zip", ["ais.csv"]), ("two.zip", ["ais.csv", "more.csv"])):
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for member in members:
                archive.writestr(member, ais_csv())
    for name in ("ais.csv.zst", "ais.zip"):
        reports = read(tmp_path / name)
        assert len(reports) == 12 and reports.mmsi[0] == "366053209"
    with pytest.raises(InputError, match=r"is an archive of 2 files; unpack it, and give the files"):
        read(tmp_path / "two.zip")
    (tmp_path / "cut.csv.zst").write_bytes(packed[: len(packed) // 2])
    (tmp_path / "bomb.zip").write_bytes(b"")
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ais.csv", b"0" * (40 << 20))
    for name, why in (("cut.csv.zst", "damaged|cut off"), ("bomb.zip", "unpacks to more than 32 MB")):
        with pytest.raises(InputError, match=why):
            read(tmp_path / name)


def test_points_of_geoparquet_are_positions(tmp_path):
    rows = ais_rows()
    points = [struct.pack("<BIdd", 1, 1, row[2], row[3]) for row in rows]
    table = pa.table({"mmsi": [row[0] for row in rows], "base_date_time": [row[1] for row in rows], "geometry": points})
    parquet.write_table(table, tmp_path / "ais.parquet")
    reports = read(tmp_path / "ais.parquet")
    assert (reports.lat_deg[1], reports.lon_deg[1]) == (50.501, -1.0)


def test_the_api_of_adsb_exchange_is_read(tmp_path):
    aircraft = {
        "hex": "3c6675",
        "flight": "DLH123 ",
        "alt_baro": 35000,
        "gs": 400,
        "lat": 50.5,
        "lon": -1.0,
        "nac_p": 9,
    }
    answer = {"ac": [aircraft], "msg": "No error", "now": START_S * 1000, "total": 1}
    reports = read(written(tmp_path, "v2.json", json.dumps(answer)))
    assert (reports.icao[0], reports.time_s[0]) == ("3c6675", START_S)


def event(k, uid="ANDROID-1", kind="a-f-G-U-C", hae="40.0", ce="9.0", point=True):
    time = stamp(k, "%Y-%m-%dT%H:%M:%S.000Z")
    place = f'<point lat="{50.5 + 0.001 * k}" lon="-1.0" hae="{hae}" ce="{ce}" le="9999999.0"/>' * point
    detail = '<detail><contact callsign="VIPER &amp; 1"/><track course="70.0" speed="6.3"/></detail>'
    times = f'time="{time}" start="{time}" stale="{time}"'
    return f'<event version="2.0" uid="{uid}" type="{kind}" {times}>{place}{detail}</event>'


def test_events_of_tak_are_reports(tmp_path):
    log = [
        *(event(k) for k in range(3)), event(3, "MMSI-235000111", "a-n-S", "9999999.0", "9999999.0"),
        event(4, kind="b-t-f"), event(5, "sameas.7", "a-u-S"), event(6, point=False), event(7, "ICAO-3C6675", "a-n-A"),
    ]  # fmt: skip
    for name, text in (("a.log", "\n".join(log)), ("b.xml", f"<?xml version='1.0'?><events>{''.join(log)}</events>")):
        reports = read(written(tmp_path, name, text))
        assert len(reports) == 5 and reports.name[0] == "VIPER & 1" and reports.course_deg[0] == 70.0
        assert reports.covariance_m2[0, 0] ** 0.5 == pytest.approx(9.0 / 2.146, abs=1e-3)
        assert reports.alt_m[0] == 40.0 and np.isnan([reports.alt_m[3], reports.covariance_m2[3, 0]]).all()
        assert (reports.mmsi[3], reports.icao[4], reports.track_id[0]) == ("235000111", "3c6675", "ANDROID-1")
        assert reports.passed_over == {"other event": 1, "object that sameas has sent": 1}
        assert reports.damaged.lines.tolist() == [7]
    with pytest.raises(InputError, match="no event of Cursor on Target with a position; give a log of events"):
        read(written(tmp_path, "chat.xml", event(0, kind="b-t-f")))


def test_topics_of_ros_are_tables(tmp_path):
    head = "%time,field.header.seq,field.header.stamp,field.latitude,field.longitude,field.altitude"
    head += ",field.position_covariance0,field.position_covariance1,field.position_covariance4"
    rows = "".join(f"{START_S + k:.0f}000000000,{k},1,{50.5 + 0.001 * k},-1.0,40.0,4.0,0,4.0\n" for k in range(3))
    fix = read(written(tmp_path, "fix.csv", f"{head}\n{rows}"))
    assert (fix.time_s[0], fix.lat_deg[1], fix.alt_m[0], fix.covariance_m2[0, 0]) == (START_S, 50.501, 40.0, 4.0)
    head = "%time,field.header.seq,field.id,field.pose.position.x,field.pose.position.y,field.twist.linear.x"
    rows = "".join(f"{START_S + k:.0f}000000000,{k},7,{5 * k},{2 * k},0.5\n" for k in range(3))
    track = read(written(tmp_path, "track.csv", f"{head}\n{rows}"))
    # The velocity of a body is none of the plane.
    assert (track.x_m[1], track.y_m[1], track.track_id[0], track.vx_m_per_s) == (5.0, 2.0, "7", None)


def test_the_position_of_gnss_in_logs_of_px4_is_in_its_units(tmp_path):
    head = "timestamp,time_utc_usec,lat,lon,alt,alt_ellipsoid,vel_n_m_s,vel_e_m_s,fix_type"
    rows = "".join(
        f"{5e6 + 1e6 * k:.0f},{START_S + k:.0f}000000,{505000000 + 1000 * k},-10000000,40000,88000,2.0,6.0,3\n"
        for k in range(3)
    )
    drone = read(written(tmp_path, "gps.csv", f"{head}\n{rows}"))
    assert (drone.time_s[0], drone.lat_deg[1], drone.lon_deg[0]) == (START_S, pytest.approx(50.5001), -1.0)
    assert (drone.alt_m[0], drone.vx_m_per_s[0], drone.vy_m_per_s[0]) == (88.0, 6.0, 2.0)


def test_a_line_for_excel_above_the_names_is_passed_over(tmp_path):
    assert len(read(written(tmp_path, "ais.csv", "sep=,\n" + ais_csv()))) == 12


def test_json_of_decoders_of_asterix_is_refused_with_the_remedy(tmp_path):
    record = {"category": 62, "CAT062": {"I010": {"SAC": 25, "SIC": 201}, "I070": {"ToT": 3600.0}}}
    with pytest.raises(InputError, match="decoder of ASTERIX has written; give the ASTERIX itself, or its pcap"):
        read(written(tmp_path, "tracks.json", json.dumps(record)))
