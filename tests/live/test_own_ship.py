"""Own ship's position and velocity from a fixed place and from the sentences of her receiver."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.live.conftest import START_S

from sameas.live.own_ship import OwnShipMotion
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
