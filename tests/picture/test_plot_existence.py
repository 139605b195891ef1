"""Objects that only plots without names show, beside sources with names: real ones are found, clutter is none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import describe
from scipy.special import expit

from sameas.picture import Picture, Watch, instants, picture_states
from sameas.picture.hull_echoes import OWN_LOOKS_KEPT
from sameas.picture.object_ids import NamedObjects
from sameas.picture.picture import error_lines
from sameas.picture.plot_existence import Looks, NewPlots, PlotOdds, looks_between
from sameas.picture.plot_rates import SourceCounts
from sameas.picture.tables import COASTING, CONFIRMED, ENDED, TENTATIVE, PictureObjects
from sameas.picture.track_existence import REAL_S
from sameas.picture.tuning import DEFAULT_TUNING
from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scans import AntennaRotation
from sameas.tracks.scene import Scene
from sameas.tracks.source import Clutter, MissRate

SPAN_S, SIDE_M = 400.0, 8000.0


def radar_beside_ais(seed, p_detected, clutter, boats=5, ships=5, shore=0.0, described=True):
    """A radar without names (every 2.5 s, ± 15 m, clutter per scan) and AIS; the boats have none. And their motion.

    shore : further plots per scan of the echoes along one side. described : whether misses and clutter are.
    """
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-0.4, 0.4, (ships + boats, 2)) * SIDE_M, rng.normal(0.0, 4.0, (ships + boats, 2))
    rows, times = [], np.arange(0.0, SPAN_S, 2.5)
    for t in times:
        shown = (start + velocity * t)[rng.random(ships + boats) < p_detected]
        false = rng.uniform(-0.5, 0.5, (rng.poisson(clutter), 2)) * SIDE_M
        along = rng.integers(-200, 200, rng.poisson(shore)) * SIDE_M / 400.0
        echoes = np.column_stack([along, np.full(len(along), 0.6 * SIDE_M)])
        measured = np.vstack([shown, echoes])
        rows += [(t, *place) for place in np.vstack([measured + rng.normal(0.0, 15.0, measured.shape), false])]
    plots = dict(zip(("time_s", "x_m", "y_m"), np.array(rows).T, strict=True))
    radar = describe("radar", "marine radar", 15.0, 2.5, clutter / (SIDE_M / 1e3) ** 2, 1.0 - p_detected)
    if not described:
        radar = replace(radar, misses=MissRate(), clutter=Clutter())
    named = {"time_s": [], "x_m": [], "y_m": [], "track_id": []}
    for k in range(ships):
        for t in np.arange(rng.uniform(0.0, 10.0), SPAN_S, 10.0):
            place = start[k] + velocity[k] * t + rng.normal(0.0, 8.0, 2)
            for name, value in zip(named, (t, *place, f"a{k}"), strict=True):
                named[name].append(value)
    ais = describe("ais", "ais", 8.0, 10.0, q=0.5)
    scene = Scene((Feed.of(radar, Reports.of("radar", "table", plots), scan_times_s=times),
                   Feed.of(ais, Reports.of("ais", "table", named), to_tracks=True)))  # fmt: skip
    return scene, lambda t: start + velocity * t


def confirmed_of(scene, motion, every_s=5.0):
    """(boats and ships, 2) share of the instants of the last minutes that show each, and numbers used; and the numbers
    that were confirmed far from all."""
    objects = Picture.of(scene, instants((0.0, SPAN_S), every_s)).objects
    number = np.asarray(objects["object"])
    used, shown, false, late = (
        [set() for _ in motion(0.0)],
        np.zeros(len(motion(0.0))),
        set(),
        np.arange(120.0, 400.0, 5.0),
    )
    for t in late:
        here = np.flatnonzero((objects["time_s"] == t) & np.isin(objects["stage"], ("confirmed", "coasting")))
        off = np.hypot(*(np.column_stack([objects["x_m"], objects["y_m"]])[here, None] - motion(t)).transpose(2, 0, 1))
        shown += (off < 100.0).any(axis=0)
        false.update(number[here[(off > 200.0).all(axis=1)]].tolist())
        for k, near in enumerate((off < 100.0).T):
            used[k].update(number[here[near]].tolist())
    return np.column_stack([shown / len(late), [len(each) for each in used]]), false


@pytest.mark.slow
@pytest.mark.parametrize(("p_detected", "clutter"), [(0.8, 40.0), (0.35, 10.0)])
@pytest.mark.long_after(1)
def test_boats_without_names_are_found_in_clutter_and_clutter_is_not_confirmed(p_detected, clutter):
    """Any three scans of five confirmed an object: in dense clutter most were false, and weak boats were none."""
    found, numbers, false, real = [], [], 0, 0
    for seed in range(2):
        of_each, far = confirmed_of(*radar_beside_ais(seed, p_detected, clutter))
        found, numbers = [*found, *of_each[:, 0]], [*numbers, *of_each[:, 1]]
        false, real = false + len(far), real + len(of_each)
    assert np.mean(found) > 0.93 and np.mean(numbers) < 1.3
    # At 99 % one of a hundred may be false; more than 2 of 20 have a chance of 1e-3.
    assert false <= 2


@pytest.mark.slow
@pytest.mark.long
def test_the_scans_between_two_instants_are_used():
    """At every 20 s, seven of eight scans were lost: boats that a scan shows with 35 % were confirmed for 17 % of the
    time."""
    scene, motion = radar_beside_ais(0, 0.35, 5.0, boats=3, ships=3)
    states = list(picture_states(scene, np.arange(20.0, SPAN_S, 20.0)))
    at_each_scan = {state.now.instant_s: state for state in picture_states(scene, np.arange(20.0, SPAN_S, 2.5))}
    for state in states:
        other = at_each_scan[state.now.instant_s].objects
        assert state.objects.number.tolist() == other.number.tolist()
        assert np.allclose(state.objects.state, other.state) and (state.objects.stage == other.stage).all()
    confirmed = np.isin(states[-1].objects.stage, (CONFIRMED, COASTING))
    off = np.hypot(*(states[-1].objects.state[confirmed, None, :2] - motion(380.0)).transpose(2, 0, 1))
    assert (off.min(axis=0) < 100.0).all() and len(off) == 6


def test_a_rotating_antenna_and_exposures_have_no_scan_twice():
    """Of exposures an instant shows the last, of a rotating antenna the plots of the last period."""
    scene, _ = radar_beside_ais(0, 0.8, 5.0)
    radar = scene.feeds[0]
    assert looks_between(scene.feeds, 100.0, 110.0) == [102.5, 105.0, 107.5]
    assert looks_between(scene.feeds, 100.0, 102.5) == looks_between(scene.feeds[1:], 100.0, 200.0) == []
    turning = replace(radar, rotation=AntennaRotation(3.0, 0.1))
    assert looks_between([turning], 100.0, 110.0) == [101.0, 104.0, 107.0]
    assert looks_between([turning], 100.0, 103.0) == []
    fast = replace(DEFAULT_TUNING, scan_every_s=6.0, scan_steps=3)
    assert looks_between([radar], 0.0, 400.0, fast) == [382.5, 390.0, 395.0]


def test_an_object_that_ends_between_two_instants_is_shown_as_ended():
    """It is dropped at the next scan, and no output would say that it has ended."""
    scene, motion = radar_beside_ais(3, 0.8, 10.0, boats=1, ships=2)
    (radar, ais), gone_s = scene.feeds, 200.0
    reports = radar.raw_reports
    off = np.column_stack([reports.x_m, reports.y_m]) - motion(reports.time_s[:, None, None])[:, -1]
    kept = reports.where(~((np.hypot(*off.T) < 120.0) & (reports.time_s > gone_s)))
    feed = Feed.of(radar.description, kept, scan_times_s=np.arange(0.0, SPAN_S, 2.5))
    _, before, after = picture_states(Scene((feed, ais)), [0.0, gone_s, gone_s + 140.0])
    number = before.objects.number[np.argmin(np.hypot(*(before.objects.state[:, :2] - motion(gone_s)[-1]).T))]
    [row] = np.flatnonzero(after.objects.number == number)
    assert after.objects.stage[row] == ENDED and not after.objects.detected[row]
    assert number in after.watch.texts


def test_the_odds_are_those_of_bayes_rule():
    """Two looks at objects that rest: the recursion is the ratio of the probabilities of all plots."""
    scene, _ = radar_beside_ais(0, 0.8, 40.0)
    now, (radar, _) = scene.at(100.0), scene.feeds
    looks = Looks.since(now, 97.5)
    assert [feed.description.name for feed in looks.feeds] == ["radar"] and looks.share.tolist() == [1.0]
    q, clutter, sigma = 0.2, radar.clutter(2), 15.0
    place = np.array([[0.0, 0.0], [500.0, 0.0]])
    objects = PictureObjects(
        np.array([1, 2]), np.column_stack([place, np.zeros((2, 2))]), np.tile(100.0 * np.eye(4), (2, 1, 1)),
        np.full(2, TENTATIVE), np.ones(2, bool), np.ones(2, bool), np.full(2, -1),
    )  # fmt: skip
    found = np.array([True, False])
    plots = NewPlots(found, place + np.array([12.0, 9.0]), np.tile(sigma**2 * np.eye(2), (2, 1, 1)),
                     np.where(found, math.log((1.0 - q) / clutter), 0.0), np.full(2, clutter),
                     np.full(2, clutter), np.full(2, "radar", object), np.zeros((2, 2, 2)))  # fmt: skip
    first = PlotOdds.begun(plots, replace(looks, per_m2=1e-6), 0.5)
    assert math.isclose(first.log_odds[0], math.log(1e-6 * 0.5 * (1.0 - q) / clutter)) and not first.known[1]
    # Of 4 looks at each object 3 missed it: with the weight of 6 looks q is 0.42.
    odds = PlotOdds(np.array([-1.0, -1.0]), np.full(2, -1.0), np.full(2, 4.0), np.full(2, 3.0))
    own_q = (6.0 * q + 3.0) / (6.0 + 4.0)
    after = odds.after(objects, plots, looks, 2.5, 0.5)
    p = math.exp(-2.5 / REAL_S) * expit(-1.0)
    total = sigma**2 + 100.0
    density = math.exp(-0.5 * (12.0**2 + 9.0**2) / total) / (2.0 * math.pi * total)
    hit = p * (1.0 - own_q) * density / (p * (1.0 - own_q) * density + (1.0 - p) * clutter)
    missed = p * own_q / (p * own_q + 1.0 - p)
    assert np.allclose(expit(after.log_odds), [hit, missed], rtol=1e-9)
    kept = 1.0 / (1.0 + 1.0 / OWN_LOOKS_KEPT)
    assert np.allclose(after.looked, kept * 4.0 + 1.0) and np.allclose(after.missed, kept * 3.0 + np.array([0.0, 1.0]))
    # An object that other sources have shown begins with its first plot; without a new look nothing is missed.
    unknown = replace(odds, log_odds=np.full(2, -math.inf))
    begun = unknown.after(objects, plots, replace(looks, per_m2=1e-6), 2.5, 0.5)
    assert begun.log_odds.tolist() == [first.log_odds[0], -math.inf]
    assert Looks.since(now, 100.0).feeds == ()
    assert Looks.since(scene.at(101.0), 100.0).p_missed(place).tolist() == [1.0, 1.0]


def test_the_share_of_objects_not_seen_before():
    scene, motion = radar_beside_ais(0, 0.8, 40.0)
    looks = Looks.since(scene.at(5.0), -math.inf)
    assert math.isclose(looks.unseen_share(1.0, motion(0.0), 0.0), 0.2)
    comes = 1.0 - math.exp(-5.0 / REAL_S)
    assert math.isclose(looks.unseen_share(0.2, motion(0.0), 5.0), 0.04 * (1.0 - comes) + comes)


@pytest.mark.slow
@pytest.mark.long
def test_what_is_assumed_is_counted_and_a_shore_is_not_boats():
    """Radar described by its kind only, which misses two of three ships, with forty echoes of a shore in each scan:
    each stretch of the shore was an object."""
    scene, motion = radar_beside_ais(1, 0.35, 5.0, shore=40.0, described=False)
    shown = np.zeros(len(motion(0.0)))
    ashore, late = [], np.arange(150.0, SPAN_S, 5.0)
    for state in picture_states(scene, np.arange(0.0, SPAN_S, 5.0)):
        if state.now.instant_s < late[0]:
            continue
        objects = state.objects.take(np.isin(state.objects.stage, (CONFIRMED, COASTING)))
        off = np.hypot(*(objects.state[:, None, :2] - motion(state.now.instant_s)).transpose(2, 0, 1))
        shown += (off < 100.0).any(axis=0)
        ashore.append(int((np.abs(objects.state[:, 1] - 0.6 * SIDE_M) < 100.0).sum()))
    assert isinstance(state.watch, Watch)
    counts = state.watch.plot_rates.of["radar"]
    assert abs(counts.miss_rate(0.1) - 0.65) < 0.05
    [line] = error_lines(state.watch)
    assert line.startswith("radar: misses 6") and "(10 % was assumed); has " in line
    assert (shown / len(late)).mean() > 0.85 and np.mean(ashore) < 4.0


def test_the_clutter_about_a_plot():
    """As dense as everywhere, denser where plots return beside each other, and not where they return to one place."""
    rng, looks = np.random.default_rng(1), 100
    far = rng.uniform(-4000.0, 4000.0, (400, 2))
    shore = (
        np.array([2000.0, 0.0]) + rng.normal(0.0, 15.0, (900, 2)) + rng.uniform(-300.0, 300.0, (900, 1)) * [0.0, 1.0]
    )
    buoy = np.array([-2000.0, 0.0]) + rng.normal(0.0, 15.0, (90, 2))
    own = [1000 + np.arange(400), 2000 + np.arange(900) % 30, np.full(90, 7), 3000 + np.arange(90)]
    counts = SourceCounts(
        place=np.vstack([far, shore, buoy, buoy + np.array([0.0, 1000.0])]), time_s=np.zeros(1480),
        look_s=np.arange(100.0), share=np.ones(looks),
        number=np.concatenate(own),
    )  # fmt: skip
    places = np.array([[0.0, 1000.0], [2000.0, 0.0], [-2000.0, 0.0], [-2000.0, 1000.0]])
    mean = 400 / 64e6 / looks
    at_sea, on_shore, *of_one = counts.clutter_per_m2(
        places, np.full(4, 15.0), np.array([0, 2001, 7, 0]), np.full(4, mean)
    )
    assert 0.3 * mean < at_sea < 3.0 * mean
    # A buoy, followed under one number, or lost and found under many.
    assert max(of_one) < 0.1 * on_shore
    # Of each look nine plots, over 600 m and a normal density across.
    on_it = 9.0 / 600.0 * 60.0 * 0.85
    assert math.isclose(on_shore, on_it / (math.pi * 900.0), rel_tol=0.25)


@pytest.mark.slow
def test_a_buoy_that_a_scan_shows_now_and_then_is_an_object_and_a_patch_of_clutter_is_none():
    """Each time it was lost and began anew, its earlier plots were clutter: it was shown for 12 % of the time."""
    rng, (buoy, patch) = np.random.default_rng(5), np.array([[1500.0, -2500.0], [-2500.0, -1500.0]])
    scene, _ = radar_beside_ais(2, 0.8, 10.0, boats=0, described=False)
    (radar, ais), times = scene.feeds, np.arange(0.0, SPAN_S, 2.5)
    more = [(t, *(buoy + rng.normal(0.0, 15.0, 2))) for t in times if rng.random() < 0.3]
    more += [(t, *(patch + rng.normal(0.0, 60.0, 2))) for t in times for _ in range(rng.poisson(2.0))]
    rows = np.vstack([np.column_stack([radar.raw_reports.time_s, radar.raw_reports.x_m, radar.raw_reports.y_m]), more])
    plots = dict(zip(("time_s", "x_m", "y_m"), rows[np.argsort(rows[:, 0], kind="stable")].T, strict=True))
    scene = Scene((Feed.of(radar.description, Reports.of("radar", "table", plots), scan_times_s=times), ais))
    objects = Picture.of(scene, instants((150.0, SPAN_S), 5.0)).objects
    confirmed = np.isin(objects["stage"], ("confirmed", "coasting"))
    at_buoy, on_patch = (
        np.hypot(objects["x_m"] - x, objects["y_m"] - y) < reach for (x, y), reach in ((buoy, 60.0), (patch, 250.0))
    )
    late = confirmed & (objects["time_s"] > 210.0)
    assert len(np.unique(objects["time_s"][late & at_buoy])) / len(np.unique(objects["time_s"][late])) > 0.8
    assert not (confirmed & on_patch).any()


@pytest.mark.slow
def test_an_object_that_no_look_shows_any_more_ends_and_a_tentative_one_is_not_shown():
    """A wrong object once coasted for eight minutes where a radar sees eight boats of ten."""
    scene, motion = radar_beside_ais(3, 0.8, 10.0)
    gone_s, (radar, ais) = 200.0, scene.feeds
    boat = motion(gone_s)[-1]
    reports = radar.raw_reports
    near = np.hypot(reports.x_m - motion(reports.time_s[:, None, None])[:, -1, 0],
                    reports.y_m - motion(reports.time_s[:, None, None])[:, -1, 1]) < 120.0  # fmt: skip
    kept = reports.where(~(near & (reports.time_s > gone_s)))
    times = np.arange(0.0, SPAN_S, 2.5)
    scene = Scene((Feed.of(radar.description, kept, scan_times_s=times), ais))
    ended = None
    for state in picture_states(scene, np.arange(0.0, SPAN_S, 2.5)):
        objects = state.objects
        hidden = (objects.stage == TENTATIVE) & ~objects.detected
        assert not hidden.any() and isinstance(state.watch.objects, NamedObjects)
        assert len(state.watch.objects) >= len(objects)
        t = state.now.instant_s
        if t == gone_s:
            off = np.hypot(*(objects.state[:, :2] - boat).T)
            number = objects.number[np.argmin(off)]
            assert objects.stage[np.argmin(off)] in (CONFIRMED, COASTING) and off.min() < 60.0
        if t > gone_s:
            own = np.flatnonzero(objects.number == number)
            if len(own) and objects.stage[own[0]] == COASTING:
                ended = t
    assert ended is not None and 5.0 < ended - gone_s < 60.0


def test_clutter_is_not_counted_as_missed_by_the_other_source():
    """Every plot was an object that AIS misses: 72 % of five ships among six false plots a scan, all with AIS."""
    scene, _ = radar_beside_ais(3, 0.5, 6.0, boats=0)
    misses = {one.source: one.share for one in Picture.of(scene, instants((60.0, 240.0), 10.0)).summary.misses}
    assert misses["ais"] < 0.05 and abs(misses["radar"] - 0.5) < 0.2
