"""Own ship's position and velocity from a fixed place and from the sentences of her receiver."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import START_S

from sameas.cli.watch import settings_of
from sameas.io.sensors.nmea import checksum
from sameas.live.keeper import Keeper
from sameas.live.own_ship import OwnShipMotion
from sameas.live.server import live_page
from sameas.live.settings import LiveSource, OwnShip, Settings, WatchSettings
from sameas.tracks import Description
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports

PLANE = LocalPlane(50.0, -1.0)
URL = "tcp://127.0.0.1:10110"


def motion(own_ship, *, wire=None, replayed=False):
    settings = Settings(
        {"bridge": LiveSource(Description("bridge", "marine radar"), URL)}, WatchSettings(own_ship=own_ship)
    )
    return OwnShipMotion(settings, {} if wire is None else {URL: wire}, replayed=replayed)


def receiver(lat_deg=50.0, lon_deg=-1.0, speed=np.nan, course=np.nan, at_s=START_S):
    """A wire whose receiver gives a place, a speed (m/s) and a course (degrees)."""
    stream = SimpleNamespace(
        own_ship=(lat_deg, lon_deg, 45.0), own_ship_s=at_s, own_velocity=(speed, course), own_mmsi="235000009"
    )
    return SimpleNamespace(stream=stream, state=SimpleNamespace(last_s=at_s))


def test_a_fixed_place_rests_and_needs_a_plane():
    fixed = motion(OwnShip(50.0, -1.0))
    assert fixed.at(START_S, START_S, None, None) is None
    for t in range(5):
        ship = fixed.at(START_S + t, START_S, None, PLANE)
    assert np.allclose([ship.x_m, ship.y_m, ship.vx_m_per_s, ship.vy_m_per_s], 0.0, atol=1e-6)
    assert fixed.source(START_S) is None and fixed.silence(START_S + 1e6, START_S) == ""
    assert motion(None).at(START_S, START_S, None, PLANE) is None


def test_a_velocity_is_that_of_the_receiver_or_else_fitted_to_the_last_positions():
    wire = receiver()
    own = motion(OwnShip(source="bridge"), wire=wire)
    for t in range(0, 40, 2):
        wire.stream.own_ship = (50.0 + 5.0 * t / 111_240.0, -1.0, 45.0)
        ship = own.at(START_S + t, START_S, None, PLANE)
    assert ship.vy_m_per_s == pytest.approx(5.0, rel=1e-3) and ship.vx_m_per_s == pytest.approx(0.0, abs=1e-3)
    wire.stream.own_velocity = (4.0, 90.0)
    ship = own.at(START_S + 40.0, START_S, None, PLANE)
    assert (ship.vx_m_per_s, ship.vy_m_per_s, ship.heading_deg) == pytest.approx((4.0, 0.0, 45.0))
    wire.stream.own_velocity = (0.0, np.nan)
    assert own.at(START_S + 41.0, START_S, None, PLANE).vx_m_per_s == 0.0


def test_a_course_is_by_true_north_far_from_the_origin_of_the_plane():
    """200 km east of it, 2° off: an approach in 20 minutes would have been wrong by 400 m, as others are turned."""
    wire = receiver(lon_deg=-1.0 + 2.8, speed=10.0, course=0.0)
    ship = motion(OwnShip(source="bridge"), wire=wire).at(START_S, START_S, None, PLANE)
    north_deg = PLANE.north_deg((ship.x_m, ship.y_m))
    assert np.degrees(np.arctan2(ship.vx_m_per_s, ship.vy_m_per_s)) == pytest.approx(north_deg, abs=1e-3)
    assert ship.x_m == pytest.approx(200e3, rel=0.01) and north_deg == pytest.approx(-2.1, abs=0.1)


def test_own_ship_is_the_one_whose_receiver_an_input_has_unless_the_settings_name_her():
    """Replayed, a log was taken so; live, the same sentences were only named in the terminal."""
    wire = receiver(lat_deg=np.nan)
    own = motion(None, wire=wire)
    assert own.at(START_S, START_S, None, PLANE) is None and own.silence(START_S + 1e6, START_S) == ""
    wire.stream.own_ship = (50.0, -1.0, 45.0)
    assert own.at(START_S, START_S, None, PLANE) is not None and own.source(START_S) == "bridge"
    # Her silence is an alarm from then on.
    assert own.silence(START_S + 100.0, START_S).startswith("bridge has given no position for")


def test_a_receiver_that_fails_leaves_no_ship_and_its_silence_is_said():
    own = motion(OwnShip(source="bridge"), wire=receiver())
    assert own.source(START_S + 60.0) == "bridge" and own.at(START_S, START_S + 60.0, None, PLANE) is not None
    assert own.silence(START_S + 60.0, START_S - 500.0) == ""
    assert own.source(START_S + 61.0) is None and own.at(START_S, START_S + 61.0, None, PLANE) is None
    assert own.silence(START_S + 61.0, START_S - 500.0) == "bridge has given no position for 60 s"
    assert own.mmsi == "235000009"


def test_a_replayed_ship_is_where_her_reports_have_the_sensor():
    own = motion(OwnShip(source="bridge"), replayed=True)
    assert own.at(START_S, START_S, None, PLANE) is None and own.silence(START_S + 1e6, START_S) == ""
    places = {"station_lat_deg": [50.0, 50.001, np.nan], "station_lon_deg": [-1.0, -1.0, np.nan]}
    targets: dict[str, Any] = {"time_s": START_S + np.arange(3.0), "range_m": [100.0] * 3, "bearing_deg": [0.0] * 3}
    own.take("another", Reports.of("another", "marine radar", targets | places))
    assert own.at(START_S, START_S, None, PLANE) is None
    own.take("bridge", Reports.of("bridge", "marine radar", targets | places))
    assert own.at(START_S, START_S, None, PLANE).y_m == pytest.approx(111.2, abs=0.1)


def test_a_replayed_ship_goes_on_between_the_reports_of_her_log():
    """A log of her receivers has her position, course and speed at each report of another ship, which may be rare."""
    own = motion(OwnShip(source="bridge"), replayed=True)
    ship = {"own_lat_deg": [50.0], "own_lon_deg": [-1.0], "own_heading_deg": [93.0], "own_speed_m_per_s": [5.0],
            "own_course_deg": [90.0]}  # fmt: skip
    own.take("bridge", Reports.of("bridge", "ais", {"time_s": [START_S], "lat_deg": [50.1], "lon_deg": [-1.1]} | ship))
    for after_s, x_m in ((0.0, 0.0), (10.0, 50.0), (100.0, 150.0)):
        state = own.at(START_S + after_s, START_S, None, PLANE)
        assert (state.x_m, state.y_m) == pytest.approx((x_m, 0.0), abs=0.05)
        assert (state.vx_m_per_s, state.vy_m_per_s, state.heading_deg) == pytest.approx((5.0, 0.0, 93.0), abs=1e-3)


def test_a_replayed_log_of_a_bridge_shows_the_ship_that_wrote_it(tmp_path):
    bodies = ["GPRMC,130212.00,A,5046.380,N,00105.576,W,10.0,157.8,120116,,,A", "RATTM,01,2.5,13,T,7,20,T,,,N,,T,,,A"]
    (tmp_path / "bridge.nmea").write_text("".join(f"${body}*{checksum(body):02X}\n" for body in bodies))
    settings, _ = settings_of([str(tmp_path / "bridge.nmea")], None, None, 10.0)
    assert settings.watch.own_ship == OwnShip(source="bridge")
    (tmp_path / "named.toml").write_text("[watch]\nown_ship = { mmsi = '235000009' }\n[sources.bridge]\n")
    settings, _ = settings_of([str(tmp_path / "bridge.nmea")], tmp_path / "named.toml", None, 10.0)
    assert settings.watch.own_ship == OwnShip(mmsi="235000009")


def test_the_log_of_a_receiver_is_own_ship_and_no_source_of_tracks(tmp_path):
    body = "GPRMC,130212.00,A,5046.380,N,00105.576,W,10.0,157.8,120116,,,A"
    (tmp_path / "gps.nmea").write_text(f"${body}*{checksum(body):02X}\n")
    (tmp_path / "ais.csv").write_text("time,mmsi,lat,lon\n2016-01-12T13:02:12Z,235000001,50.8,-1.1\n")
    settings, replay = settings_of([str(tmp_path / "gps.nmea"), str(tmp_path / "ais.csv")], None, None, 10.0)
    keeper = Keeper(settings, replay=replay)
    assert keeper.own_ship.carrier == "gps"
    page = live_page(keeper, operator=True)
    keeper.close()
    assert '"name":"gps","kind":"own ship"' in page and '"name":"ais","kind":"ais"' in page


def test_a_replayed_track_has_its_speed_by_the_times_of_its_reports():
    """At 30 times real time the instants are 30 s apart: by these she was at rest every other time."""
    own = motion(OwnShip(source="bridge"), replayed=True)
    for k in range(4):
        times = START_S + 30.0 * k + np.arange(0.0, 30.0, 5.0)
        lat, lon = PLANE.to_geodetic(np.column_stack([3.0 * (times - START_S), 4.0 * (times - START_S)]))
        places = {"lat_deg": lat, "lon_deg": lon, "own_lat_deg": lat, "own_lon_deg": lon}
        own.take("bridge", Reports.of("bridge", "own ship", {"time_s": times} | places))
        state = own.at(START_S + 30.0 * (k + 1), START_S, None, PLANE)
        assert (state.vx_m_per_s, state.vy_m_per_s) == pytest.approx((3.0, 4.0), abs=1e-3)
        assert (state.x_m, state.y_m) == pytest.approx((90.0 * (k + 1), 120.0 * (k + 1)), abs=0.5)


def test_a_table_of_her_path_is_own_ship_of_a_replay_and_comes_before_the_radar_aboard(tmp_path):
    """Five in six plots of a replay at many times real time had no place, since hers came after them."""
    rows = [f"{START_S + k},{50.0 + 5e-5 * k:.6f},-1.0,0,9.7" for k in range(60)]
    (tmp_path / "voyage.csv").write_text("time,lat,lon,heading,sog\n" + "\n".join(rows) + "\n")
    plots = [f"{START_S + k},900,{k}" for k in range(1, 60)]
    (tmp_path / "radar.csv").write_text("time,range_m,relative_bearing\n" + "\n".join(plots) + "\n")
    (tmp_path / "ais.csv").write_text(f"time,mmsi,lat,lon\n{START_S},235000001,50.01,-1.0\n")
    files = [str(tmp_path / f"{name}.csv") for name in ("radar", "ais", "voyage")]
    settings, replay = settings_of(files, None, None, 10.0)
    assert settings.watch.own_ship == OwnShip(source="voyage")
    keeper = Keeper(settings, replay=replay)
    replay.begin(0.0)
    keeper.reception.take(replay.last_s)
    counts = keeper.picture.counts["radar"]
    state = keeper.reception.sources["radar"]
    assert keeper.own_ship.carrier == "voyage" and (counts.taken, counts.unplaced) == (59, 0), state
    keeper.close()
