"""Registration of a scene: biases within their errors, with and without a reference, and no harm without biases."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from harbour import harbour

from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.tracks import (
    BiasPrior,
    Clutter,
    Description,
    KnownBiases,
    MissRate,
    Motion,
    Reports,
    Scene,
    SensorCoverage,
    SensorErrors,
    Site,
    Timing,
)
from sameas.tracks.bias_fit import Pool
from sameas.tracks.placement import Directions
from sameas.tracks.snapshot import ComparedSource, common_scans
from sameas.tracks.source import Targets

NAMES = ("range_m", "azimuth_deg", "time_s")


def normalised(found, truth):
    """(biases,) errors in units of their standard errors."""
    return [
        (found.parameters[name].value - true) / found.parameters[name].standard_error for name, true in truth.items()
    ]


def pair_f1(made, scene, instant_s):
    """F1 of the pairs of the first two sources at an instant."""
    now = scene.at(instant_s)
    answer = identify_many(now.sources, rule=now.rule(), region=now.region)
    owners = [own[records_of(source).ids] for own, source in zip(made.owners, now.sources, strict=True)]
    both = ~np.ma.getmaskarray(answer.members)[:, :2].any(axis=1)
    i, j = answer.members[both][:, :2].T
    right = np.sum((owners[0][i] == owners[1][j]) & (owners[0][i] >= 0))
    possible = len(np.intersect1d(owners[0][owners[0] >= 0], owners[1]))
    return 2.0 * right / (both.sum() + possible)


@pytest.mark.slow
def test_biases_of_a_radar_against_ais_are_found_within_their_errors():
    apart = []
    for seed in range(7):
        made = harbour(seed, (20, 40, 60)[seed % 3], sigma=(25.0, 50.0)[seed % 2], q=(0.1, 0.3)[seed // 2 % 2])
        registered, (radar, ais) = made.scene.registered()
        apart.append(normalised(radar, dict(zip(NAMES, (50.0, 1.0, 3.0), strict=True))))
        assert radar.established and radar.notes == () and radar.against == ("ais",) and not ais.parameters
        assert pair_f1(made, registered, 350.0) > max(pair_f1(made, made.scene, 350.0), 0.9)
    assert np.mean(np.abs(apart) < 3.0) >= 0.95 and np.abs(apart).max() < 4.5
    # Standard errors are neither too small nor much too large.
    assert 0.4 < np.sqrt(np.mean(np.square(apart))) < 1.5


@pytest.mark.slow
def test_without_a_bias_none_is_found_and_no_pair_is_lost():
    for seed in range(2):
        made = harbour(seed + 20, biases=((0.0, 0.0, 0.0),))
        registered, (radar, _) = made.scene.registered()
        assert np.abs(normalised(radar, dict.fromkeys(NAMES, 0.0))).max() < 3.5
        assert pair_f1(made, registered, 350.0) >= pair_f1(made, made.scene, 350.0) - 0.03
        grown = registered.feeds[0].reports.covariance[:, 0, 0] / made.scene.feeds[0].reports.covariance[:, 0, 0]
        assert 1.0 <= np.median(grown) < 1.3


@pytest.mark.slow
def test_a_bias_as_large_as_the_distance_of_neighbours_is_found():
    # 2.5° at 15 km are 650 m; ships are about 700 m apart.
    made = harbour(31, 60, biases=((-120.0, -2.5, 0.0),))
    _, (radar, _) = made.scene.registered()
    assert radar.established
    assert np.abs(normalised(radar, {"range_m": -120.0, "azimuth_deg": -2.5})).max() < 4.0


@pytest.mark.slow
def test_two_radars_without_a_reference_are_aligned():
    apart = []
    for seed in range(2):
        truth = (50.0, 1.0, 0.0), (-35.0, -0.7, 0.0)
        made = harbour(seed + 40, 40, biases=truth, ais=False, until_s=150.0)
        registered, found = made.scene.registered()
        for radar, true in zip(found, truth, strict=True):
            apart += normalised(radar, dict(zip(NAMES[:2], true[:2], strict=True)))
            assert any("neither it nor radar" in note for note in radar.notes)
        assert any("have no reference" in note for radar in found for note in radar.notes)
        assert pair_f1(made, registered, 140.0) > max(0.85, pair_f1(made, made.scene, 140.0))
        # A common displacement of both is uncertain, but not included in the errors of one relative to the other.
        own = [np.sqrt(np.median(scene.feeds[0].reports.covariance[:, 0, 0])) for scene in (made.scene, registered)]
        assert own[1] < 1.6 * own[0]
    assert np.abs(apart).max() < 3.5


@pytest.mark.slow
def test_a_reference_can_be_chosen_and_a_known_bias_fixed():
    made = harbour(50, 30, until_s=200.0)
    (about, reports), ais = made.sources
    fixed = replace(
        about, calibration=KnownBiases(50.0, 1.0), timing=Timing(3.0, 3.0, 0.2), bias=BiasPrior(0.0, 0.0, 0.0, 0.0)
    )
    scene = Scene.of([(fixed, reports), ais])
    registered, found = scene.registered()
    assert [str(one) for one in found] == [
        f"{n}: not corrected, the reference for the others" for n in ("radar 1", "ais")
    ]
    assert pair_f1(made, registered, 190.0) > 0.9
    shifted = Scene.of([(about, reports), (replace(ais[0], bias=BiasPrior(shift_m=100.0)), ais[1])])
    _, found = shifted.registered(references=["radar 1"])
    assert set(found[1].parameters) == {"east_m", "north_m"} and not found[0].parameters
    with pytest.raises(
        InputError, match=r"'radar' is not a source of positions; give some of radar 1, ais as references"
    ):
        scene.registered(["radar"])


def test_the_shift_of_a_source_without_a_site_is_found():
    made = harbour(60, 30, until_s=200.0)
    about, reports = made.sources[1]
    rng = np.random.default_rng(1)
    moved = replace(reports, x_m=reports.x_m + 80.0 + 10 * rng.standard_normal(len(reports)), y_m=reports.y_m - 45.0,
                    mmsi=None, track_id=reports.mmsi)  # fmt: skip
    other = Description("other", "tracks", motion=about.motion, errors=SensorErrors(position_m=15.0, speed_m_per_s=0.3))
    _, (_, found) = Scene.of([made.sources[1], (other, moved)]).registered()
    assert np.abs(normalised(found, {"east_m": 80.0, "north_m": -45.0})).max() < 3.5
    assert 5 <= found.tracks <= 30 and "east" in str(found)


def test_the_azimuth_bias_of_a_camera_is_found():
    made = harbour(70, 25, biases=(), until_s=120.0)
    rng = np.random.default_rng(2)
    rows = []
    for t in np.arange(0.0, 120.0, 2.0):
        at = made.start + t * made.velocity
        away, bearing = np.hypot(*at.T), np.degrees(np.arctan2(at[:, 0], at[:, 1]))
        seen = (away < 8000.0) & (rng.random(len(at)) > 0.2)
        rows += [[t, b + 1.7 + 0.3 * rng.standard_normal()] for b in bearing[seen]]
    time_s, bearing = np.array(rows).T
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0), coverage=SensorCoverage(8000.0), misses=MissRate(0.2),
        clutter=Clutter(per_deg=0.001), errors=SensorErrors(bearing_deg=0.3, extent_m=5.0),
        timing=Timing(2.0, 0.0, 0.0), motion=Motion(0.01, 8.0),
    )  # fmt: skip
    columns = {"time_s": time_s, "bearing_deg": bearing}
    scene = Scene.of([*made.sources, (camera, Reports.of("camera", "table", columns))])
    registered, (_, found) = scene.registered()
    assert found.established and abs(normalised(found, {"azimuth_deg": 1.7})[0]) < 3.5
    before, after = scene.feeds[1].reports, registered.feeds[1].reports
    assert isinstance(before, Directions) and isinstance(after, Directions)
    turned = (before.bearing_deg - after.bearing_deg) % 360.0
    np.testing.assert_allclose(turned, found.parameters["azimuth_deg"].value)
    # Hulls of 5 m stay 5 m wide, seen from some kilometres; ships go at some metres a second.
    for met in common_scans(ComparedSource(scene.feeds[0], None), ComparedSource(scene.feeds[1], 0)):
        assert 0.0 < met.lasting_m2 < 0.1
        assert 1.0 < met.speed_m_per_s < 20.0


def speeding_up(seed, every_s, sigma_m):
    """Reports of 40 ships of a seed that gain 3 m/s a minute: columns, velocities (n, 2) and ships (n,)."""
    rng = np.random.default_rng(seed)
    start, course = rng.uniform(-6e3, 6e3, (40, 2)), rng.uniform(0.0, 2.0 * np.pi, 40)
    way = np.column_stack([np.sin(course), np.cos(course)])
    rng = np.random.default_rng([seed, int(every_s)])
    ship, turn = (a.ravel() for a in np.meshgrid(np.arange(40), np.arange(0.0, 300.0, every_s)))
    time_s = turn + every_s * rng.random(40)[ship]
    place = start[ship] + way[ship] * (2.0 * time_s + 0.025 * time_s**2)[:, None]
    place += sigma_m * rng.standard_normal(place.shape)
    return {"time_s": time_s, "x_m": place[:, 0], "y_m": place[:, 1]}, way[ship] * (2.0 + 0.05 * time_s)[:, None], ship


def test_a_record_at_a_direction_finder_itself_has_no_bearing():
    """Aircraft of which a radar measures less than their assumed height lie at its site: to a nanometre, and then with
    a bearing as accurate as that, or with a variance of 0, which was refused."""
    site, time_s = Site(lat_deg=50.0, lon_deg=-1.0), np.repeat(np.arange(8) * 4.0, 2)
    bearings: dict[str, Any] = {"time_s": time_s, "bearing_deg": [30.0, 200.0] * 8}
    ranges = {**bearings, "range_m": [2_000.0, 19_000.0] * 8}
    radar = (
        Description("radar", "air radar", site=site, targets=Targets(5000.0, 500.0)),
        Reports.of("radar", "table", ranges),
    )
    esm = Description("esm", "esm", site=site), Reports.of("esm", "table", bearings)
    one, other = Scene.of([radar, esm]).feeds
    scans = common_scans(ComparedSource(one, None), ComparedSource(other, 0))
    assert scans and all(len(scan.weighing.first) == 1 for scan in scans)
    assert min(scan.weighing.first.covariance.min() for scan in scans) > 1e-4


@pytest.mark.slow
def test_filter_lag_of_accelerating_ships_is_no_time_bias():
    motion = Motion(acceleration_m2_per_s3=0.01, speed_m_per_s=8.0)
    radar = Description(
        "radar", "marine radar", site=Site(east_m=0.0, north_m=-9e3), errors=SensorErrors(position_m=50.0),
        motion=motion, bias=BiasPrior(range_m=50.0, azimuth_deg=1.0, time_s=2.0), misses=MissRate(0.1),
    )  # fmt: skip
    ais = Description("ais", "ais", errors=SensorErrors(position_m=5.0), motion=motion, misses=MissRate(0.1))
    for seed in range(3):
        plots, _, ship = speeding_up(seed, 3.0, 50.0)
        reports, velocity, name = speeding_up(seed, 10.0, 5.0)
        reports |= {"vx_m_per_s": velocity[:, 0], "vy_m_per_s": velocity[:, 1], "mmsi": 235_000_000 + name}
        scene = Scene.of([
            (radar, Reports.of("radar", "table", plots | {"track_id": ship})), (ais, Reports.of("ais", "ais", reports)),
        ])  # fmt: skip
        assert scene.feeds[0].filtered
        _, (found, _) = scene.registered()
        assert np.abs(normalised(found, dict.fromkeys(NAMES, 0.0))).max() < 4.0


@pytest.mark.slow
def test_sources_without_common_objects_are_not_moved():
    made = harbour(80, 12, biases=((0.0, 0.0, 0.0),), until_s=100.0)
    radar, (about, reports) = made.sources
    rng = np.random.default_rng(3)
    lost = replace(reports, x_m=rng.uniform(-12e3, 12e3, len(reports)), y_m=rng.uniform(-9e3, 9e3, len(reports)))
    scene = Scene.of([radar, (about, lost)])
    registered, (found, _) = scene.registered()
    assert not found.established and any("no object in common with ais" in note for note in found.notes)
    assert registered.feeds[0].reports is scene.feeds[0].reports and "NOT ESTABLISHED" in str(found)
    later = Scene.of([radar, (about, replace(reports, time_s=reports.time_s + 1e5))])
    registered, (found, _) = later.registered()
    assert found.notes == ("radar 1: has no report at the times of ais; its biases were not fitted",)
    assert registered.feeds[0] is later.feeds[0]


@pytest.mark.parametrize("kinds", [("lidar", "marine radar"), ("marine radar", "marine radar")])
def test_plots_without_a_site_and_without_velocities_show_no_bias(kinds):
    # Only their time stamps can be biased, and that cannot be determined.
    rng, t = np.random.default_rng(5), np.repeat(np.arange(0.0, 30.0), 2)
    place = np.array([[-100.0, 20.0], [80.0, -30.0]])[np.arange(60) % 2] + t[:, None] * [2.0, 1.0]
    sources = []
    for k, kind in enumerate(kinds):
        x_m, y_m = (place + 2.0 * rng.normal(size=place.shape)).T
        about = Description(f"{kind} {k}", kind, errors=SensorErrors(position_m=2.0))
        sources.append((about, Reports.of(f"{kind} {k}", "table", {"time_s": t, "x_m": x_m, "y_m": y_m})))
    scene = Scene.of(sources)
    registered, found = scene.registered()
    assert registered.feeds == scene.feeds and not any(source.parameters for source in found)
    assert any("only its latency may be biased" in note for source in found for note in source.notes)


def test_too_few_tracks_are_reported():
    made = harbour(90, 2, biases=((0.0, 0.0, 0.0),), until_s=150.0)
    _, (found, _) = made.scene.registered()
    assert any("too few tracks" in note for note in found.notes)


def test_the_score_is_the_gradient_of_the_posterior_over_all_instants():
    made = harbour(100, 20, biases=((30.0, 0.5, 0.0), (-20.0, 0.3, 0.0)), until_s=60.0)
    radars = made.scene.feeds[:2]
    met = common_scans(ComparedSource(radars[0], 0), ComparedSource(radars[1], 6), 3)
    pool = Pool(met)
    assert pool.biases.tolist() == [0, 1, 6, 7] and len(met) == 3
    theta = np.array([[25.0, 0.45, -15.0, 0.25]])
    common = [np.array([12.0])] * 3
    score, information = pool.equations(theta, pool.weighed(theta, common, 1.0))
    for k, step in enumerate(0.02 / np.sqrt(np.diagonal(information[0]))):
        near = [theta + sign * step * np.eye(4)[k] for sign in (1.0, -1.0)]
        up, down = (pool.gain(at, pool.weighed(at, common, 1.0))[0] for at in near)
        # The common field moves slightly with the biases.
        assert abs((up - down) / (2.0 * step) - score[0, k]) * step / 0.02 < 0.5


def airspace(seed, late_s, n=60, period_s=5.0, span_s=150.0):
    """Aircraft with ADS-B every second, and the plots of a radar that turns, each at its own time; its range is 80 m
    too long, its azimuth 0.2° off, and its stamps are late."""
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(-9e4, 9e4, (n, 2)), rng.uniform(0.0, 2.0 * np.pi, n)
    velocity = rng.uniform(150.0, 250.0, n)[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    times = np.arange(0.0, span_s) + rng.uniform(0.0, 0.3, (n, 1))
    place = start[:, None] + times[..., None] * velocity[:, None] + 10.0 * rng.standard_normal((n, len(times[0]), 2))
    adsb = {
        "time_s": times.ravel(), "x_m": place[..., 0].ravel(), "y_m": place[..., 1].ravel(),
        "vx_m_per_s": np.repeat(velocity[:, 0], len(times[0])), "vy_m_per_s": np.repeat(velocity[:, 1], len(times[0])),
        "icao": np.repeat([f"{0x3C0000 + k:06x}" for k in range(n)], len(times[0])),
    }  # fmt: skip
    begun = period_s * np.arange(span_s / period_s)
    swept = begun + np.zeros((n, 1))
    for _ in range(4):
        x, y = np.moveaxis(start[:, None] + swept[..., None] * velocity[:, None], -1, 0)
        swept = begun + period_s * (np.degrees(np.arctan2(x, y)) % 360.0) / 360.0
    order = np.argsort(swept.ravel())
    radar = {
        "time_s": (swept + late_s).ravel()[order],
        "range_m": (np.hypot(x, y) + 80.0 + 50.0 * rng.standard_normal(x.shape)).ravel()[order],
        "bearing_deg": (np.degrees(np.arctan2(x, y)) + 0.2 + 0.06 * rng.standard_normal(x.shape)).ravel()[order] % 360,
    }  # fmt: skip
    errors = SensorErrors(position_m=10.0, speed_m_per_s=1.0, course_deg=1.0)
    return Scene.of([
        (Description("adsb", "ads-b", errors=errors, timing=Timing(1.0, 0.0, 0.0)), Reports.of("adsb", "table", adsb)),
        (Description("radar", "air radar", site=Site(east_m=0.0, north_m=0.0)), Reports.of("radar", "table", radar)),
    ])  # fmt: skip


@pytest.mark.parametrize("late_s", [0.0, 0.8])
def test_plots_of_a_rotation_are_compared_each_at_its_own_time(late_s):
    """All at the time of the last, they are behind aircraft by half of a rotation: the stamps seemed a second late."""
    _, (_, radar) = airspace(4, late_s).registered()
    assert radar.established and radar.tracks > 50
    assert np.abs(normalised(radar, {"range_m": 80.0, "azimuth_deg": 0.2, "time_s": late_s})).max() < 3.5
    assert radar.parameters["range_m"].standard_error < 10.0
