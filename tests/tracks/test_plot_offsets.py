"""Offsets of a small radar's plots in clutter: found from all scans jointly, and not without common objects."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.boat_radar import boat_radar

from sameas.errors import InputError
from sameas.picture import Picture, instants
from sameas.registration.offsets import range_and_azimuth
from sameas.simulate.sensors import Bias
from sameas.tracks import Clutter, Description, MissRate, Reports, SensorErrors, Site, Timing, plot_offsets
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.plot_fit import Knots
from sameas.tracks.plot_offsets import fit_plots
from sameas.tracks.plot_pairs import (
    MAX_SIGMA_M,
    SEEN_SHARES,
    Blocks,
    Path,
    Plots,
    log_mean_over_seen,
    shows_bare_plots,
    shows_tracks,
)
from sameas.tracks.scene import Scene


def drawn(seed, azimuth_deg, **counts):
    return boat_radar(np.random.default_rng(seed), bias=Bias(20.0, azimuth_deg, time_s=0.5), **counts)


def fitted(scene):
    radar, ais = Scene.of(scene.sources).feeds
    return fit_plots(radar, [ais])


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "azimuth_deg"), [(4, 7.5), (10, -7.7), (1, 4.0), (3, 0.5)])
def test_three_vessels_in_clutter_establish_an_offset_within_its_error(seed, azimuth_deg):
    scene = Scene.of(drawn(seed, azimuth_deg, common=3).sources)
    assert scene.doubts() == ()
    found = scene.registered()[1][0]
    azimuth = found.parameters["azimuth_deg"]
    assert found.established and found.against == ("ais",)
    assert abs(azimuth.value - azimuth_deg) < min(4.0 * azimuth.standard_error, 0.5)


@pytest.mark.slow
def test_doubts_and_registration_fit_the_same_plots_once(monkeypatch):
    fits = []

    def counted(*given):
        fits.append(fit_plots(*given))
        return fits[-1]

    monkeypatch.setattr(plot_offsets, "fit_plots", counted)
    scene = Scene.of(drawn(4, 7.5, common=3, minutes=3.0).sources)
    scene.doubts()
    registered, _ = scene.registered()
    assert len(fits) == 1
    registered.doubts()  # another scene with the radar at another position
    assert len(fits) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [100, 101])
def test_vessels_never_seen_by_the_radar_establish_no_offset(seed):
    scene = Scene.of(drawn(seed, 3.0, common=0, moored=0, unseen=6, silent=3, minutes=5.0).sources)
    registered, (found, _) = scene.registered()
    assert not found.established and registered.feeds[0].reports is scene.feeds[0].reports
    assert "is not corrected" in " ".join(found.notes)
    assert len(scene.doubts()) == 1 and scene.doubts()[0].startswith("radar: ")


def with_other_ships(seed, minutes, ships=8):
    """AIS of some ships, and a radar that shows as many others, all under way."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-6e3, 6e3, (2, ships, 2)), rng.normal(0.0, 5.0, (2, ships, 2))
    plots, fixes = [], []
    for t in np.arange(0.0, 60.0 * minutes, 3.0):
        of_others, of_own = place + speed * t
        seen = of_others[rng.random(ships) < 0.9]
        plots += [(t, *one) for one in seen + 25.0 * rng.standard_normal(seen.shape)]
        fixes += [
            (t, *of_own[k] + 10.0 * rng.standard_normal(2), *speed[1, k], k) for k in range(int(t / 3) % 4, ships, 4)
        ]
    time_s, x_m, y_m = np.transpose(plots)
    columns = {"range_m": np.hypot(x_m, y_m), "bearing_deg": np.degrees(np.arctan2(x_m, y_m))}
    radar = Reports.of("radar", "table", {"time_s": time_s, **columns})
    time_s, x_m, y_m, vx, vy, mmsi = np.transpose(fixes)
    motion = {"vx_m_per_s": vx, "vy_m_per_s": vy, "mmsi": mmsi.astype(int)}
    ais = Reports.of("ais", "ais", {"time_s": time_s, "x_m": x_m, "y_m": y_m, **motion})
    errors = SensorErrors(range_m=20.0, range_share=0.0, bearing_deg=0.3, extent_m=5.0)
    described = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), errors=errors)
    return Scene.of([(described, radar), (Description("ais", "ais", errors=SensorErrors(position_m=10.0)), ais)])


@pytest.mark.slow
@pytest.mark.parametrize("minutes", [1.5, 10.0])
def test_other_ships_that_cross_the_paths_of_tracks_establish_no_offset(minutes):
    fits = [with_other_ships(seed, minutes).registered()[1][0] for seed in range(20)]
    assert [fit.log_evidence for fit in fits if fit.established] == []


@pytest.mark.slow
def test_stationary_plots_are_background_and_no_evidence():
    """A moored vessel amid stationary echoes: hundreds of plots at its position are one coincidence."""
    moored = fitted(drawn(7, 2.0, common=0, moored=4, unseen=0, silent=0))
    moving = fitted(drawn(7, 2.0, common=4, moored=0, unseen=0, silent=0))
    assert moored.pairs > 50.0 and moving.established
    assert moored.log_evidence < moving.log_evidence - 10.0


def drifting(seed, common=5, **more):
    """A scene whose compass drifts by 2° within two minutes, with fading echoes and ships at berths."""
    return drawn(seed, 3.0, common=common, compass_deg=2.0, compass_s=120.0, fading_s=30.0, berthed=4, **more)


@pytest.mark.slow
def test_boats_in_a_marina_that_the_radar_does_not_see_hide_no_offset():
    """Four ships under way, and thirty boats with AIS at berths, each of which is in view and never detected."""
    marina = {"moored": 0, "unseen": 0, "berthed": 30, "berthed_seen": False}
    found = fitted(drawn(2, 3.0, common=4, **marina))
    assert found.established and abs(found.theta[1] - 3.0) < 0.5
    nobody = [fitted(drawn(seed, 3.0, common=0, silent=4, **marina)) for seed in (2, 3, 4)]
    assert not any(fit.established for fit in nobody)


def azimuth_of(reports, sensor_m):
    return range_and_azimuth(reports.state[:, :2] - sensor_m)[:, 1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_compass_that_drifts_is_followed(seed):
    drawn_scene = drifting(seed)
    scene = Scene.of(drawn_scene.sources)
    registered, (found, _) = scene.registered()
    azimuth, mean = found.parameters["azimuth_deg"], 3.0 + drawn_scene.heading_error_deg.mean()
    assert found.established and abs(azimuth.value - mean) < min(0.3, 3.0 * azimuth.standard_error)
    assert "drifts by" in " ".join(found.notes)
    # The plots themselves turn by what the compass was off at their time.
    before, after = scene.feeds[0], registered.feeds[0]
    assert isinstance(before.reports, States) and isinstance(after.reports, States)
    turned = azimuth_of(before.reports, before.sensor_m) - azimuth_of(after.reports, after.sensor_m)
    scan = ((before.reports.time_s - before.reports.time_s.min()) // 2.5).astype(int)
    error = (turned - 3.0 - drawn_scene.heading_error_deg[scan] + 180.0) % 360.0 - 180.0
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.std(drawn_scene.heading_error_deg)


def test_more_ais_in_view_than_plots_in_a_scan_is_no_reason_to_compare_single_scans():
    radar, ais = Scene.of(drawn(3, 4.0, common=5, moored=5, unseen=35, minutes=4.0).sources).feeds
    fit = fit_plots(radar, [ais])
    assert fit is not None and fit.instants == 96


def test_the_drift_has_the_covariance_of_an_ornstein_uhlenbeck_process():
    knots = Knots(np.array([0.0, 30.0, 90.0, 100.0]))
    covariance = np.exp(-np.abs(knots.time_s[:, None] - knots.time_s) / 60.0)
    assert np.allclose(knots.precision(60.0) @ covariance, np.eye(4))
    knot, share = knots.around(np.array([15.0, 100.0]))
    assert knot.tolist() == [[0, 1], [2, 3]] and np.allclose(share, [[0.5, 0.5], [0.0, 1.0]])
    assert np.allclose(knots.mean_weights(np.array([0.0, 60.0])), [0.5, 0.25, 0.25, 0.0])
    fixed = Knots.of(np.arange(9.0), np.zeros((9, 2)))
    assert len(fixed) == 0


def test_bare_plots_and_tracks_are_distinguished():
    radar, ais = Scene.of(drawn(2, 1.0, minutes=2.0).sources).feeds
    assert (shows_bare_plots(radar), shows_tracks(radar)) == (True, False)
    assert (shows_bare_plots(ais), shows_tracks(ais)) == (False, True)
    assert fit_plots(radar, []) is None


def test_the_simulated_scene_is_as_described():
    scene = drawn(5, 3.0, common=4)
    per_turn = np.bincount(scene.truth + 1) / 240.0
    assert 0.4 < per_turn[1:5].sum() < 3.0 and 4.0 < per_turn[0] < 11.0
    assert scene.common.tolist() == [0, 1, 2, 3] and len(scene.mmsi) == 6
    assert np.allclose(np.mod(scene.sources[0][1].bearing_deg, 0.5), 0.0)
    with pytest.raises(InputError, match="give none or more"):
        boat_radar(np.random.default_rng(1), common=-1)


@pytest.mark.slow
def test_two_search_peaks_with_one_solution_are_not_ambiguous():
    rng = np.random.default_rng(2035)
    azimuth_deg = rng.uniform(0.5, 8.0) * rng.choice([-1, 1])
    bias = Bias(rng.normal(0.0, 25.0), azimuth_deg, time_s=rng.uniform(0.0, 1.5))
    found = fitted(boat_radar(rng, bias=bias, common=3))
    assert found.established and abs(found.theta[1] - azimuth_deg) < 0.3


@pytest.mark.slow
@pytest.mark.long
def test_echoes_of_the_shore_beside_a_berth_are_not_surely_the_ship_there():
    """The radar sees a ship in one scan of five, and the quay beside her as often; both were assumed otherwise."""
    sure = wrong = 0
    for seed in (1, 2, 3):
        drawn_scene = drifting(seed, minutes=8.0)
        scene = Scene.of(drawn_scene.sources).registered()[0]
        radar = scene.feeds[0].description
        assert 0.7 < radar.misses.at(0.0) < 0.95 and 0.02 < (radar.clutter.per_km2 or 0.0) < 0.2
        assert not {line.name for line in radar.assumed} & {"misses.q", "clutter.per_km2"}
        assert len(scene.estimated) == 1 and "plots per km² and scan" in scene.estimated[0]
        records = Picture.of(scene, instants(scene.span_s, every_s=20.0)).records
        vessel = {mmsi: k for k, mmsi in enumerate(drawn_scene.mmsi)}
        for t in np.unique(records["time_s"]):
            at = records["time_s"] == t
            of = {name: at & (records["source"] == name) for name in ("radar", "ais")}
            ships = dict(zip(records["object"][of["ais"]], records["track_id"][of["ais"]], strict=True))
            for row, number, p in zip(*(records[c][of["radar"]] for c in ("row", "object", "p_object")), strict=True):
                if number in ships and p > 0.9:
                    sure, wrong = sure + 1, wrong + (vessel[ships[number]] != drawn_scene.truth[row])
    assert sure > 80 and wrong < 0.06 * sure


@pytest.mark.slow
def test_described_misses_and_clutter_are_kept():
    (radar, plots), ais = drifting(2, minutes=8.0).sources
    radar = replace(radar, misses=MissRate(0.5), clutter=Clutter(per_km2=0.3))
    radar = replace(radar, assumed=tuple(one for one in radar.assumed if one.name[:6] not in ("misses", "clutte")))
    registered, (found, _) = Scene.of([(radar, plots), ais]).registered()
    assert found.established and registered.estimated == ()
    assert (registered.feeds[0].description.misses.q, registered.feeds[0].clutter(2)) == (0.5, 0.3e-6)


@pytest.mark.slow
@pytest.mark.parametrize("p_detected", [0.9, 0.5])
def test_the_counted_misses_are_those_of_a_radar_that_shows_each_ship_once(p_detected):
    """Misses of 10 % were given as 57 %, as of a Poisson number of plots a scan, and drawn to a low rate."""
    rng, plane, times = np.random.default_rng(1), LocalPlane(50.7, -1.2), np.arange(0.0, 600.0, 2.5)
    start, velocity = rng.uniform(-4e3, 4e3, (6, 2)), rng.normal(0.0, 4.0, (6, 2))
    plots, ais = [], []
    for t in times:
        shown = (start + t * velocity)[rng.random(6) < p_detected]
        place = np.vstack([shown + rng.normal(0.0, 15.0, shown.shape), rng.uniform(-4e3, 4e3, (rng.poisson(10), 2))])
        plots += [(t, np.hypot(x, y), np.degrees(np.arctan2(x, y))) for x, y in place]
    for k in range(6):
        for t in np.arange(rng.uniform(0.0, 10.0), 600.0, 10.0):
            lat, lon = plane.to_geodetic((start[k] + t * velocity[k] + rng.normal(0.0, 8.0, 2))[None])
            speed, course = np.hypot(*velocity[k]), np.degrees(np.arctan2(*velocity[k]))
            ais.append((t, lat[0], lon[0], speed, course % 360.0, f"23500000{k}"))
    columns = zip(("time_s", "range_m", "bearing_deg"), np.array(plots).T, strict=True)
    radar = Reports.of("radar", "table", dict(columns))
    names = ("time_s", "lat_deg", "lon_deg", "speed_m_per_s", "course_deg", "mmsi")
    others = Reports.of("ais", "ais", {name: [row[k] for row in ais] for k, name in enumerate(names)})
    described = Description("radar", "marine radar", site=Site(50.7, -1.2), timing=Timing(2.5))
    scene = Scene.of([(described, radar), (Description("ais", "ais"), others)], plane).registered()[0]
    assert abs(scene.feeds[0].description.misses.q - (1.0 - p_detected)) < 0.06


@pytest.mark.slow_after(1)
def test_the_offsets_of_a_radar_for_aircraft_without_ids_are_found():
    """Aircraft have no hull, whose errors of zero made all numbers NaN; the antenna turns in 4.8 s, usual are 8 s."""
    rng = np.random.default_rng(8)
    place, speed = rng.uniform(-5e4, 5e4, (12, 2)), 200.0 * rng.normal(size=(12, 2))
    plots, fixes = [], []
    for turn in np.arange(60):
        for k in np.flatnonzero(rng.random(12) < 0.9):
            east, north = place[k] + speed[k] * 4.8 * turn
            bearing = np.degrees(np.arctan2(east, north)) % 360.0
            t = 4.8 * (turn + bearing / 360.0)
            east, north = place[k] + speed[k] * t
            plots.append([t, np.hypot(east, north) + 80.0 + 60.0 * rng.normal(),
                          (np.degrees(np.arctan2(east, north)) + 0.25 + 0.08 * rng.normal()) % 360.0])  # fmt: skip
        seen = place + speed * 4.8 * turn + 20.0 * rng.normal(size=(12, 2))
        fixes += [[4.8 * turn, f"39d3{k:02d}", *seen[k], *speed[k]] for k in range(12)]
    time_s, range_m, bearing_deg = np.array(plots).T
    t, icao, x, y, vx, vy = zip(*fixes, strict=True)
    columns = {"time_s": t, "icao": icao, "track_id": icao, "x_m": x, "y_m": y,
               "speed_m_per_s": np.hypot(vx, vy), "course_deg": np.degrees(np.arctan2(vx, vy)) % 360.0}  # fmt: skip
    scene = Scene.of([
        (Description("tower", "air radar", site=Site(east_m=0.0, north_m=0.0)),
         Reports.of("tower", "table", {"time_s": time_s, "range_m": range_m, "bearing_deg": bearing_deg})),
        (Description("adsb", "ads-b", errors=SensorErrors(position_m=20.0), timing=Timing(latency_s=0.0)),
         Reports.of("adsb", "table", columns)),
    ])  # fmt: skip
    assert scene.feeds[0].rotation.period_s == pytest.approx(4.8, rel=1e-2)
    found = scene.registered()[1][0]
    assert found.established
    for name, true in (("range_m", 80.0), ("azimuth_deg", 0.25)):
        one = found.parameters[name]
        assert abs(one.value - true) < 4.0 * one.standard_error < 0.5 * true


def test_a_radar_sees_at_least_two_of_the_tracks():
    """With fewer tracks the smallest shares that are seen would cost nothing, and any two agree somewhere by chance."""
    unseen = np.full((9, 1), -np.inf)
    due = np.mean([(1.0 - seen) ** 9 for seen in SEEN_SHARES if seen >= 2.0 / 9.0])
    np.testing.assert_allclose(np.exp(log_mean_over_seen(unseen)), due, rtol=1e-12)
    np.testing.assert_allclose(log_mean_over_seen(unseen[:1]), np.log(1.0 - SEEN_SHARES[-1]), rtol=1e-12)


def test_blocks_of_plots_leave_out_only_plots_while_a_track_is_out_of_reach():
    """Of two hours of a coast, most tracks were compared with all plots of radars that never see them."""
    rng, n, reach_m = np.random.default_rng(12), 3000, 10e3
    time_s = np.sort(rng.uniform(0.0, 7200.0, n))
    sensor = np.column_stack([4.0 * time_s, np.zeros(n)])
    none = np.zeros(n)
    plots = Plots(time_s, np.arange(n), sensor, sensor, none, none, np.ones((n, 2)), np.arange(n))
    blocks, n_within = Blocks.of(plots), []
    for _ in range(40):
        at_s = np.sort(rng.uniform(0.0, 7200.0, rng.integers(2, 60)))
        velocity = rng.uniform(-15.0, 15.0, 2)
        place = rng.uniform(-40e3, 40e3, 2) + velocity * (at_s - 3600.0)[:, None]
        state = np.column_stack([place, np.broadcast_to(velocity, place.shape)])
        covariance = np.diag([100.0, 100.0, 0.1, 0.1]) * np.ones((len(at_s), 1, 1))
        path = Path(at_s, state, covariance, np.full(len(at_s), 0.01))
        there, error = path.at(time_s)
        is_near = np.hypot(*(there[:, :2] - sensor).T) <= reach_m
        is_near &= error[:, :2, :2].max(axis=(1, 2)) < MAX_SIGMA_M**2
        within = blocks.within(reach_m, path)
        assert np.isin(np.flatnonzero(is_near), within).all()
        n_within.append(len(within))
    assert 0 in n_within and np.mean(n_within) < 0.5 * n
