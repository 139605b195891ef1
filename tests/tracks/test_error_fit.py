"""Errors of bare plots estimated from differences between sources; numbers given by the user are kept."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sameas import match_picture
from sameas.picture.plot_tracker import PlotTracker
from sameas.tracks.error_fit import TrackErrorFit, common_error_m, estimated_miss_rate, field_size, fit_errors
from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Scene
from sameas.tracks.source import Clutter, Description, MissRate, SensorErrors, Site, Timing

SITE = Site(east_m=0.0, north_m=0.0)
#: 1σ of ranges (m) and bearings (°), wander over the hull (m), period (s), clutter per scan, time stamp lateness (s).
TRUTH = {
    "lidar": (0.4, 0.4, 1.2, 0.5, 0.3, 0.0),
    "radar": (4.0, 1.0, 2.5, 1.5, 2.0, 1.0),
    "camera": (0.0, 1.5, 1.5, 0.5, 3.0, 0.0),
}
KIND = {"lidar": "lidar", "radar": "marine radar", "camera": "camera"}
UNTIL_S = 200.0


def course(vessel, t):
    """Two vessels at 30 to 130 m, sometimes 20 m apart."""
    t = np.asarray(t)[..., None]
    first = np.concatenate([90.0 * np.sin(t / 35.0), 75.0 + 40.0 * np.cos(t / 50.0)], axis=-1)
    other = np.concatenate([80.0 * np.cos(t / 30.0 + 1.0), 70.0 - 35.0 * np.sin(t / 45.0)], axis=-1)
    return (first, other)[vessel]


def feed_of(rng, name, described, until_s=UNTIL_S, p_shown=lambda range_m: 0.8, period_s=None, twice=0.0, empty=True):
    """Plots of a sensor at the origin; twice : probability that it shows a vessel as two plots.
    empty : whether the times of empty scans are known."""
    a, b, e, period, clutter, late = TRUTH[name]
    clutter, period = (clutter, period) if period_s is None else (clutter * period_s / period, period_s)
    times = np.arange(0.0, until_s, period)
    columns = {"time_s": [], "bearing_deg": [], "range_m": []}
    for t in times.tolist():
        plots = []
        for vessel in (0, 1):
            is_shown = rng.random() < p_shown(np.hypot(*course(vessel, t)))
            for _ in range(is_shown * (1 + (twice > 0.0 and rng.random() < twice))):
                place = course(vessel, t) + e * rng.standard_normal(2)
                r, beta = np.hypot(*place), np.degrees(np.arctan2(*place))
                plots.append((r + a * rng.standard_normal(), beta + b * rng.standard_normal()))
        for x in rng.uniform(-150.0, 150.0, (rng.poisson(clutter), 2)):
            plots.append((np.hypot(*x), np.degrees(np.arctan2(*x))))
        for r, beta in plots:
            for key, value in zip(columns, (t + late, beta, r), strict=True):
                columns[key].append(value)
    if name == "camera":
        del columns["range_m"]
    return Feed.of(described, Reports.of(name, "table", columns), scan_times_s=times + late if empty else None)


def scene(seed, until_s=UNTIL_S, **described):
    rng = np.random.default_rng(seed)
    parts = {name: described.get(name, Description(name, KIND[name], site=SITE)) for name in TRUTH}
    return Scene(tuple(feed_of(rng, name, each, until_s, empty=False) for name, each in parts.items()))


@pytest.fixture(scope="module")
def fitted():
    return scene(1).with_fitted_errors()


@pytest.mark.slow
def test_errors_clutter_and_lateness_are_estimated(fitted):
    after, fit = fitted
    assert fit.fitted == tuple(TRUTH)
    for feed in after.feeds:
        a, b, e, _, clutter, late = TRUTH[feed.description.name]
        errors, timing = feed.description.errors, feed.description.timing
        # At the vessels' 80 m, within a factor of 1.6: correlated errors leave about twenty independent scans.
        across = np.hypot(np.radians(b) * 80.0, e)
        found = np.hypot(np.radians(errors.bearing_deg) * 80.0, errors.extent_m)
        assert abs(np.log(found / across)) < np.log(1.6), feed.description.name
        assert timing.latency_s == pytest.approx(late, abs=0.3)
        if feed.description.name == "camera":
            assert feed.description.clutter.per_deg == pytest.approx(clutter / 360.0, rel=0.4)
        else:
            along = np.hypot(errors.range_m, errors.extent_m) / np.hypot(a, e)
            assert abs(np.log(along)) < np.log(1.6), feed.description.name
            assert timing.latency_sigma_s == 0.0


def test_estimated_numbers_are_reported_and_not_listed_as_assumed(fitted):
    after, fit = fitted
    listed = {f"{line.source} {line.name}" for feed in after.feeds for line in feed.description.assumed}
    assert not {"lidar errors.range_m", "radar errors.bearing_deg", "camera clutter.per_deg"} & listed
    assert not {"lidar misses.q", "radar misses.q", "camera misses.q"} & listed
    assert "lidar resolution.range_m" in listed
    assert " misses " in fit.lines()[0]
    assert fit.lines()[1].startswith("radar: range ± ") and fit.lines()[1].endswith(" s late")


def test_numbers_given_by_the_user_are_kept():
    radar = Description(
        "radar",
        "marine radar",
        site=SITE,
        errors=SensorErrors(range_m=9.0),
        clutter=Clutter(7.0),
        timing=Timing(latency_s=0.4),
    )
    after, _ = scene(2, radar=radar).with_fitted_errors()
    kept = after.feeds[1].description
    assert (kept.errors.range_m, kept.clutter.per_km2, kept.timing.latency_s) == (9.0, 7.0, 0.4)
    assert kept.errors.bearing_deg != radar.errors.bearing_deg


@pytest.mark.slow
def test_few_scans_single_sources_and_stated_errors_are_not_fitted():
    whole = scene(3)
    assert fit_errors(whole.feeds[:1]).feeds == whole.feeds[:1]
    assert fit_errors(whole.feeds[2:]).shared_m == 0.0
    few = scene(3, until_s=6.0).feeds
    assert fit_errors(few).fitted == () and fit_errors(few).feeds == few
    stating = replace(whole.feeds[0].description, errors=SensorErrors(position_m=1.0, extent_m=0.0))
    stated = Feed.of(stating, whole.feeds[0].raw_reports)
    assert fit_errors((stated, *whole.feeds[1:])).feeds[0] is stated


def test_a_source_that_always_shows_one_side_does_not_make_the_hull_smaller():
    # The errors of two sources on a ship of 36 m: one scatters over the hull, one always shows the near side.
    both, one_side = common_error_m(np.array([5.0, 5.0])), common_error_m(np.array([5.0, 0.1]))
    assert 0.7 * both < one_side < both


@pytest.mark.slow
def test_common_errors_are_in_the_fused_covariance_only():
    after, fit = scene(4).with_fitted_errors()
    assert fit.shared_m > 0.0
    now = after.at(20.0, features=POSITION_AND_VELOCITY)
    without = PlotTracker().advance(replace(now, shared_error_m=0.0))
    tracks = PlotTracker().advance(now)
    added = np.zeros((4, 4))
    added[:2, :2] = fit.shared_m**2 * np.eye(2)
    assert np.allclose(tracks.covariance, without.covariance + added)
    assert np.array_equal(tracks.state, without.state)


@pytest.mark.slow
def test_a_picture_of_bare_plots_reports_its_estimates(tmp_path):
    lines = []
    for feed in scene(6, until_s=80.0).feeds[:2]:
        raw, name = feed.raw_reports, feed.description.name
        rows = np.column_stack([raw.time_s, raw.range_m, raw.bearing_deg])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="time_s,range_m,bearing_deg", comments="")
        lines.append(f'[sources.{name}]\nkind = "{KIND[name]}"\nsite = {{ east_m = 0, north_m = 0 }}\n')
    (tmp_path / "sensors.toml").write_text("".join(lines))
    files = [str(tmp_path / f"{name}.csv") for name in ("lidar", "radar")]
    made = match_picture(files, sensors=tmp_path / "sensors.toml", at=40.0)
    text = " ".join(made.report().split())
    assert "estimated lidar: range ± " in text and "estimated radar: range ± " in text
    assert "errors.range_m 15" not in text and "misses.q 0.3" in text
    made.write(tmp_path / "picture", format="csv", map=False, image=False)
    summary = json.loads((tmp_path / "picture" / "summary.json").read_text())
    assert [line.split(":")[0] for line in summary["estimated"]] == ["lidar", "radar"]
    assert not {"errors.range_m", "clutter.per_km2"} & {line["name"] for line in summary["assumed"]}


@pytest.mark.slow
def test_how_often_a_source_misses_an_object_is_estimated_by_range():
    def shown(range_m):
        return 0.9 if range_m < 80.0 else 0.3

    found = []
    for seed in (7, 8, 9):
        rng = np.random.default_rng(seed)
        parts = [Description(name, KIND[name], site=SITE) for name in TRUTH]
        feeds = [feed_of(rng, p.name, p, p_shown=shown if p.name == "lidar" else lambda r: 0.8) for p in parts]
        misses = [feed.description.misses for feed in fit_errors(feeds).feeds]
        found.append([*misses[0].at([50.0, 120.0]), *(np.mean(each.at([60.0, 110.0])) for each in misses[1:])])
    near, far, radar, camera = np.mean(found, axis=0)
    assert near < 0.35 and far > 0.5
    assert radar == pytest.approx(0.2, abs=0.1) and 0.1 < camera < 0.4


def test_miss_rates_that_the_user_gave_and_those_of_two_sources_are_kept():
    given = Description("lidar", "lidar", site=SITE, misses=MissRate(0.15))
    after, _ = scene(2, lidar=given).with_fitted_errors()
    assert after.feeds[0].description.misses == MissRate(0.15)
    pair, _ = replace(after, feeds=scene(2).feeds[:2]).with_fitted_errors()
    assert [feed.description.misses.q for feed in pair.feeds] == [0.3, 0.1]
    assert all("misses" not in line for line in TrackErrorFit(pair.feeds, ("lidar", "radar")).lines())


@pytest.mark.slow
def test_scans_that_no_other_source_can_be_compared_with_are_no_clutter():
    rng = np.random.default_rng(11)
    parts = {name: Description(name, KIND[name], site=SITE) for name in TRUTH}
    feeds = [feed_of(rng, name, each, period_s=0.1 if name == "camera" else None) for name, each in parts.items()]
    camera = fit_errors(feeds).feeds[2]
    assert len(camera.scan_times_s) == 2000
    # 0.6 false plots in each exposure, of which one in five is nearest to one of the lidar.
    assert camera.description.clutter.per_deg == pytest.approx(0.6 / 360.0, rel=0.4)


@pytest.mark.slow
def test_second_plots_of_a_hull_count_as_clutter():
    rng = np.random.default_rng(12)
    parts = {name: Description(name, KIND[name], site=SITE) for name in TRUTH}
    feeds = [feed_of(rng, name, each, twice=0.5 if name == "lidar" else 0.0) for name, each in parts.items()]
    lidar = fit_errors(feeds).feeds[0]
    per_scan = lidar.description.clutter.per_km2 * field_size(lidar)
    # 1.6 vessels, half of them twice, and 0.3 false plots.
    assert per_scan == pytest.approx(1.1, rel=0.3)


@pytest.mark.parametrize("range_m", [[50.0] * 60, [50.0] * 59 + [50.2], [50.0] * 30 + [90.0] * 30, list(range(60))])
@pytest.mark.parametrize("weight", [[0.5] * 60, [0.0] * 30 + [1.0] * 30, [0.01] * 59 + [30.0], [1.0, 0.0] * 30])
def test_miss_rates_of_ships_that_lie_still_or_weigh_nothing_are_defined(range_m, weight):
    part = [np.array(range_m, np.float64), np.array(weight), np.full(60, 0.6)]
    found = estimated_miss_rate(Description("lidar", "lidar", misses=MissRate(0.3)), [part])
    assert np.all((found.at([10.0, 50.0, 100.0]) >= 0.3) & (found.at([10.0, 50.0, 100.0]) < 0.4))
