"""Antennas of ships that are far from the middle of what a radar sees."""

import numpy as np
import pytest

from sameas.picture.live import LivePicture
from sameas.tracks.alignment import States
from sameas.tracks.antennas import antenna_lines, antenna_offsets, with_antennas
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import BiasPrior, Description, SensorErrors

SPAN_S, EVERY_S = 900.0, 10.0
T = np.arange(0.0, SPAN_S, EVERY_S)


def turning(east_m, north_m, course_deg, speed=8.0, turn_deg_per_s=0.05):
    """(n, 2), (n, 2) positions and velocities of a ship that turns."""
    course = np.radians(course_deg + turn_deg_per_s * T)
    velocity = speed * np.column_stack([np.sin(course), np.cos(course)])
    return np.array([east_m, north_m]) + np.cumsum(velocity * EVERY_S, axis=0), velocity


def reports(source, ships, ahead_m, sigma_m, rng, ids):
    """Reports of ships (position, velocity), ahead of their positions by metres along their courses."""
    rows = {name: [] for name in ("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", ids)}
    for k, ((position, velocity), ahead) in enumerate(zip(ships, ahead_m, strict=True)):
        along = velocity / np.maximum(np.hypot(*velocity.T), 1e-9)[:, None]
        seen = position + np.multiply.outer(np.broadcast_to(ahead, len(T)), [1.0, 1.0]) * along
        seen = seen + rng.normal(0.0, sigma_m, seen.shape)
        for name, column in (("time_s", T), ("x_m", seen[:, 0]), ("y_m", seen[:, 1]), ("vx_m_per_s", velocity[:, 0]),
                             ("vy_m_per_s", velocity[:, 1]), (ids, [f"23500000{k}"] * len(T))):  # fmt: skip
            rows[name].extend(column)
    rows["covariance_m2"] = [[sigma_m**2, 0.0, sigma_m**2]] * len(rows["time_s"])
    return Reports.of(source, "table", rows)


def scene(ships, antennas_m, rng, *, echoes=None):
    """AIS and a tracking radar, whose errors are 10 and 15 m; echoes : what the radar sees, if not the ships."""
    seen = ships if echoes is None else echoes
    ais = Description("ais", "ais", errors=SensorErrors(position_m=10.0, extent_m=10.0))
    radar = Description("radar", "tracks", errors=SensorErrors(position_m=15.0), bias=BiasPrior(shift_m=0.0))
    return Scene.of([
        (ais, reports("ais", ships, antennas_m, 4.0, rng, "mmsi")),
        (radar, reports("radar", seen, np.zeros(len(seen)), 15.0, rng, "track_id")),
    ])  # fmt: skip


def fleet(n, rng):
    return [turning(3000.0 * k, rng.normal(0, 500), rng.uniform(0, 360)) for k in range(n)]


def test_antennas_of_large_ships_are_found_and_those_of_small_ones_left():
    rng = np.random.default_rng(1)
    antennas_m = np.array([-100.0, 80.0, -60.0, 3.0, -2.0, 4.0])
    feeds = scene(fleet(6, rng), antennas_m, rng).feeds
    offsets = antenna_offsets(feeds)["ais"]
    assert sorted(offsets) == ["235000000", "235000001", "235000002"]
    assert [offsets[f"23500000{k}"] for k in range(3)] == pytest.approx([100.0, -80.0, 60.0], abs=12.0)
    assert antenna_lines({"ais": offsets})[0].startswith("ais: the antennas of 3 ships are ")


def test_the_positions_of_a_ship_whose_antenna_is_far_from_its_echo_are_those_of_its_middle():
    rng = np.random.default_rng(2)
    ships = fleet(8, rng)
    antennas_m = np.array([-110.0, *rng.normal(0.0, 5.0, 7)])
    moved, _ = scene(ships, antennas_m, rng).registered()
    ais = moved.feeds[0].reports
    own = np.flatnonzero(ais.track == "235000000")
    truth = ships[0][0][own % len(T)]
    assert np.hypot(*(ais.state[own, :2] - truth).mean(axis=0)) < 15.0
    assert moved.antennas["ais"]["235000000"] == pytest.approx(110.0, abs=15.0)
    assert any("antenna" in line for line in moved.estimated)


@pytest.mark.parametrize("case", ["another passes", "dragged away", "two echoes", "at rest", "too few looks", "across"])
def test_what_is_no_antenna_moves_nothing(case):
    rng = np.random.default_rng(3)
    ships = fleet(5, rng)
    antennas_m = [np.zeros(len(T)) for _ in ships]
    echoes = list(ships)
    if case == "another passes":  # a slower ship that AIS does not know, and no echo of its own
        position, velocity = ships[0]
        along = velocity / np.hypot(*velocity.T)[:, None]
        echoes[0] = position + np.linspace(-200.0, 200.0, len(T))[:, None] * along, velocity
    if case == "dragged away":  # a false position that runs ahead
        antennas_m[0] = np.linspace(0.0, 200.0, len(T))
    if case == "two echoes":
        antennas_m[0] = np.full(len(T), -80.0)
        echoes.append((ships[0][0] + [250.0, 0.0], ships[0][1]))
    if case == "at rest":
        antennas_m[0] = np.full(len(T), -80.0)
        still = np.zeros((len(T), 2)), np.tile([0.0, 0.3], (len(T), 1))
        ships[0] = echoes[0] = still
    if case == "across":  # two ships abreast, one without AIS, one without an echo
        position, velocity = ships[0]
        across = velocity[:, ::-1] * (1.0, -1.0) / np.hypot(*velocity.T)[:, None]
        echoes[0] = position + 120.0 * across, velocity
    feeds = scene(ships, antennas_m, rng, echoes=echoes).feeds
    if case == "too few looks":
        assert antenna_offsets(feeds[:1]) == {}
        return
    assert "235000000" not in antenna_offsets(feeds).get("ais", {})


def test_positions_move_along_the_course_and_less_where_a_ship_is_slow():
    rng = np.random.default_rng(4)
    feed = scene(fleet(2, rng), np.zeros(2), rng).feeds[0]
    assert isinstance(feed.reports, States)
    feed.reports.state[:2, 2:] = [[6.0, 0.0], [0.0, 0.5]]
    current = feed.succession
    moved = with_antennas(feed, {"235000000": 100.0})
    assert isinstance(moved.reports, States)
    assert (moved.reports.state - feed.reports.state)[:2, :2] == pytest.approx(np.array([[100.0, 0.0], [0.0, 25.0]]))
    others = feed.reports.track == "235000001"
    assert np.array_equal(moved.reports.state[others], feed.reports.state[others])
    assert moved.succession is current
    assert with_antennas(feed, {}) is feed


def test_a_live_picture_has_the_antennas_once_it_has_registered():
    rng = np.random.default_rng(5)
    ships = fleet(6, rng)
    given = scene(ships, np.array([-100.0, 0.0, 0.0, 0.0, 0.0, 0.0]), rng).given
    live = LivePicture([description for description, _ in given])
    for description, batch in given:
        live.add(description.name, batch)
    before = live.advance(T[-1])
    live.register()
    after = live.advance(T[-1] + 0.1)
    large = [state.scan.state[np.flatnonzero(state.scan.track == "235000000")[0], :2] for state in (before, after)]
    assert np.hypot(*(large[1] - large[0])) == pytest.approx(100.0, abs=15.0)
