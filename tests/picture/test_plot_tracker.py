"""Plot tracker: objects are followed from scan to scan without ids, and each scan is used once."""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.many.identify import identify_many, identify_sequentially
from sameas.many.observations import Region, joint_density, records_of
from sameas.many.rules import PoissonObjects
from sameas.picture.bernoulli import (
    DIFFERENT_QUANTILE,
    KNOWN,
    MERGING_LOG_ODDS,
    SAME_QUANTILE,
    BernoulliObjects,
    BernoulliTable,
    Sighting,
)
from sameas.picture.plot_tracker import PlotTracker
from sameas.picture.tuning import Tuning
from sameas.records import Records
from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION, POSITION_AND_VELOCITY, Scene
from sameas.tracks.source import (
    Clutter,
    Description,
    MissRate,
    Motion,
    Resolution,
    SensorCoverage,
    SensorErrors,
    Site,
    Timing,
)

WALK = Motion(0.02, 4.0)
REGION = Region(np.zeros(4), (200.0, 200.0, 4.0, 4.0))


def sensor(name, sigma_m, period_s, q=0.2, clutter_per_km2=20.0):
    """A source of bare plots in a plane of its own."""
    return Description(
        name, "lidar", site=Site(east_m=0.0, north_m=0.0), coverage=SensorCoverage(range_m=1e4), misses=MissRate(q),
        motion=WALK, clutter=Clutter(clutter_per_km2), timing=Timing(period_s, 0.0, 0.0),
        errors=SensorErrors(position_m=sigma_m, extent_m=0.0),
    )  # fmt: skip


def plots(rng, description, tracks, until_s, reach_m=300.0):
    """A feed of scans of tracks (functions of time), with misses, errors and clutter as described."""
    times = np.arange(0.0, until_s, description.timing.period_s)
    columns = {"time_s": [], "x_m": [], "y_m": []}
    false = description.clutter.per_km2 * (2.0 * reach_m) ** 2 / 1e6
    for t in times.tolist():
        places = [track(t) for track in tracks if rng.random() >= description.misses.q and track(t) is not None]
        seen = [np.asarray(x) + description.errors.position_m * rng.standard_normal(2) for x in places]
        seen += list(rng.uniform(-reach_m, reach_m, (rng.poisson(false), 2)))
        for x in seen:
            for name, value in zip(columns, (t, *x), strict=True):
                columns[name].append(value)
    return Feed.of(description, Reports.of(description.name, "table", columns), scan_times_s=times)


def course(start, velocity, until_s=np.inf):
    return lambda t: np.asarray(start) + t * np.asarray(velocity) if t < until_s else None


def crossing(seed, q=0.2, until_s=60.0):
    """Two crossing vessels, 12 m apart at the closest, observed by a radar and a lidar."""
    rng = np.random.default_rng(seed)
    tracks = (course((-120.0, 6.0), (4.0, 0.0)), course((120.0, -6.0), (-4.0, 0.0)))
    near, far = sensor("lidar", 2.0, 0.5, q), sensor("radar", 4.0, 1.5, q)
    feeds = tuple(plots(rng, description, tracks, until_s) for description in (near, far))
    return Scene(feeds), tracks


def followed(scene, times, tracker=None):
    """The tracker's objects at each of the instants."""
    tracker, tracks, out = tracker or PlotTracker(correlation_s=0.0), None, []
    for t in times:
        now = replace(scene.at(t, features=POSITION_AND_VELOCITY), region=REGION, density=3e-8)
        tracks = tracker.advance(now, tracks)
        out.append(tracks)
    return out


def there(tracks, place, within_m=8.0):
    """(number, distance) of the most probable object near a position; (0, inf) if there is none."""
    off = np.linalg.norm(tracks.state[:, :2] - place, axis=1)
    near = np.flatnonzero((off < within_m) & (tracks.prior_of >= 0))
    if not len(near):
        return 0, np.inf
    k = near[tracks.existence[near].argmax()]
    return int(tracks.number[k]), float(off[k])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_two_that_cross_keep_their_numbers_among_misses_and_clutter(seed):
    scene, tracks = crossing(seed)
    times = np.arange(6.0, 54.0, 1.0)
    every = list(zip(times, followed(scene, times), strict=True))
    found = [[there(f, track(t)) for track in tracks] for t, f in every if t >= 10.0]
    numbers, off = np.array([[n for n, _ in row] for row in found]), np.array([[d for _, d in row] for row in found])
    changes = np.count_nonzero(np.diff(numbers, axis=0))
    assert changes == 0, numbers
    assert len(np.unique(numbers)) == 2
    assert np.quantile(off, 0.95) < 6.0


def test_the_odds_of_separate_objects_are_bounded_by_the_tuning():
    scene, _ = crossing(0)
    tracker = PlotTracker(correlation_s=0.0, tuning=Tuning(separate_log_odds=0.5))
    odds = np.concatenate([f.prior_objects.separate_log_odds.ravel() for f in followed(scene, range(6, 16), tracker)])
    assert np.abs(odds).max() == 0.5


@pytest.mark.slow
def test_positions_are_better_than_those_of_the_best_sensor():
    own, fused, square = [], [], []
    for seed in range(2):
        scene, tracks = crossing(seed)
        times = np.arange(10.0, 59.0, 1.0)
        for t, f in zip(times, followed(scene, times), strict=True):
            for track in tracks:
                off = np.linalg.norm(f.state[:, :2] - track(t), axis=1)
                k = int(np.where(f.existence > 0.5, off, np.inf).argmin())
                if f.members[k, 0] >= 0 and off[k] < 15.0:
                    seen = records_of(f.now.sources[0]).features[f.members[k, 0]]
                    age = f.now.age_s[0][f.members[k, 0]]
                    own.append(np.linalg.norm(seen - track(t - age)))
                    fused.append(off[k])
                    delta = f.state[k, :2] - track(t)
                    square.append(delta @ np.linalg.solve(f.covariance[k, :2, :2], delta) / 2.0)
    assert np.sqrt(np.mean(np.square(fused))) < 0.8 * np.sqrt(np.mean(np.square(own)))
    # Covariances are consistent, apart from wrong members and process noise without real manoeuvres.
    assert 0.4 < np.mean(square) < 1.6


@pytest.mark.slow
def test_clutter_is_not_confirmed_and_undetected_objects_end():
    rng = np.random.default_rng(5)
    track = course((0.0, 50.0), (1.0, 0.0), until_s=30.0)
    both = sensor("lidar", 2.0, 0.5, clutter_per_km2=60.0), sensor("radar", 4.0, 1.5, clutter_per_km2=60.0)
    feeds = [plots(rng, description, [track], 90.0) for description in both]
    times = np.arange(1.0, 89.0, 1.0)
    found = followed(Scene(tuple(feeds)), times)
    n_existing = np.array([np.count_nonzero(f.existence > 0.9) for f in found])
    assert np.mean(n_existing[(times > 5.0) & (times < 29.0)] == 1) > 0.9
    assert np.mean(n_existing[times > 45.0] == 0) > 0.9
    assert there(found[int(np.searchsorted(times, 29.0))], track(29.0))[0] > 0
    assert there(found[-1], (60.0, 50.0), within_m=30.0)[0] == 0


@pytest.mark.slow
def test_a_scan_is_used_once():
    """Lidar and radar scan at 4.0 and 3.0, and again at 4.5: nothing new in between."""
    scene, _ = crossing(1)
    seldom, often = followed(scene, [4.2, 4.45, 4.95]), followed(scene, [4.2, *np.arange(4.21, 4.45, 0.01), 4.45, 4.95])
    assert len(seldom[-1].prior_objects) > 3
    np.testing.assert_array_equal(seldom[-1].prior_objects.number, often[-1].prior_objects.number)
    for column in ("state", "covariance", "existence"):
        np.testing.assert_allclose(
            getattr(often[-1].prior_objects, column), getattr(seldom[-1].prior_objects, column), rtol=1e-6, atol=1e-9
        )
    # Numbers of sightings are equal, up to their decay with time.
    np.testing.assert_allclose(often[-1].prior_objects.hits, seldom[-1].prior_objects.hits, rtol=1e-6)


@pytest.mark.slow
def test_prior_states_come_from_earlier_scans_only():
    """No double counting: the lidar plots of an instant are not in the prior state of that instant."""
    scene, _ = crossing(1, until_s=12.0)
    times = np.arange(1.0, 10.0, 0.5)
    lidar, radar = scene.feeds
    one, other = (followed(Scene((feed, radar)), times)[-1] for feed in (lidar, moved_look(lidar, 9.5, (40.0, 0.0))))
    for column in ("number", "state", "covariance", "existence", "hits", "misses", "separate_log_odds"):
        np.testing.assert_array_equal(getattr(one.prior_objects, column), getattr(other.prior_objects, column))
    assert len(one.prior_objects) > 3 and not np.array_equal(np.sort(one.state[:, 0]), np.sort(other.state[:, 0]))


def moved_look(feed, look_s, step_m):
    """A feed with all plots of one scan shifted."""
    given = feed.reports
    place = given.state[:, :2] + np.where(given.time_s[:, None] == look_s, step_m, 0.0)
    columns = {"time_s": given.time_s, "x_m": place[:, 0], "y_m": place[:, 1]}
    return Feed.of(
        feed.description, Reports.of(feed.description.name, "table", columns), scan_times_s=feed.scan_times_s
    )


@pytest.mark.slow
def test_an_ambiguous_source_does_not_hinder_another():
    """Four bearings fit a turning boat, so the assignment is ambiguous; the lidar plots are used."""
    rng = np.random.default_rng(2)
    times = np.arange(0.0, 30.0, 0.5)

    def boat(t):
        return np.array([6.0 * min(t, 15.0) - 60.0, 100.0 + 6.0 * max(t - 15.0, 0.0)])

    lidar = plots(rng, sensor("lidar", 1.0, 0.5, q=0.02, clutter_per_km2=1.0), [boat], 30.0)
    sight = np.array([np.degrees(np.arctan2(*boat(t))) for t in times]).repeat(4) + 0.7 * rng.standard_normal(240)
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0), coverage=SensorCoverage(range_m=500.0),
        misses=MissRate(0.1), motion=WALK, clutter=Clutter(per_deg=0.05),
        errors=SensorErrors(bearing_deg=1.0, extent_m=1.0),
        timing=Timing(0.5, 0.0, 0.0),
    )  # fmt: skip
    seen = {"time_s": times.repeat(4), "bearing_deg": sight % 360.0}
    scene = Scene((lidar, Feed.of(camera, Reports.of("camera", "table", seen))))
    instants_s = np.arange(5.0, 29.0, 0.5)
    off, open_ = [], []
    for t, f in zip(instants_s, followed(scene, instants_s), strict=True):
        k = int(np.linalg.norm(f.state[:, :2] - boat(t), axis=1).argmin())
        if f.prior_of[k] >= 0 and f.members[k, 0] >= 0:
            off.append(np.linalg.norm(f.prior_objects.state[f.prior_of[k], :2] - boat(t)))
            open_.append(f.probability[k])
            assert f.p_association[0][f.prior_of[k], f.members[k, 0]] > 0.9
    assert len(off) > 40 and np.median(open_) < 0.6
    assert np.sqrt(np.mean(np.square(off))) < 3.0


@pytest.mark.slow
def test_the_order_of_sources_changes_nothing():
    scene, _ = crossing(2, until_s=12.0)
    times = np.arange(1.0, 11.0, 0.5)
    one, other = followed(scene, times), followed(Scene(scene.feeds[::-1]), times)
    for a, b in zip(one, other, strict=True):
        first, second = np.lexsort(a.state.T), np.lexsort(b.state.T)
        np.testing.assert_allclose(a.state[first], b.state[second], atol=1e-6)
        np.testing.assert_allclose(a.existence[first], b.existence[second], atol=1e-9)
        np.testing.assert_array_equal(a.members[first], b.members[second][:, ::-1])


@pytest.mark.slow
def test_a_source_that_missed_an_object_is_expected_to_miss_it_again():
    """A boat never seen by the camera passes under a spot on the lens, which then hardly matches the boat."""
    rng = np.random.default_rng(7)
    boat = course((-60.0, 100.0), (2.0, 0.0))
    lidar = plots(rng, sensor("lidar", 2.0, 0.5, clutter_per_km2=1.0), [boat], 60.0)
    times = np.arange(0.0, 60.0, 0.5)
    camera = Description(
        "camera", "camera", site=Site(east_m=0.0, north_m=0.0),
        coverage=SensorCoverage(range_m=500.0),
        misses=MissRate(0.3), motion=WALK, clutter=Clutter(per_deg=0.03),
        errors=SensorErrors(bearing_deg=1.5, extent_m=2.0),
        timing=Timing(0.5, 0.0, 0.0),
    )  # fmt: skip
    spot = (2.0 + 0.2 * rng.standard_normal(len(times))) % 360.0
    scene = Scene((lidar, Feed.of(camera, Reports.of("camera", "table", {"time_s": times, "bearing_deg": spot}))))
    instants_s = np.arange(15.0, 27.0, 0.5)
    found = followed(scene, instants_s, PlotTracker())
    number = there(found[-1], boat(instants_s[-1]))[0]
    own = found[-1].rule.known_q[found[-1].prior_objects.number == number][0]
    assert own[0] < 0.25 and own[1] > 0.6
    later = np.arange(27.0, 37.0, 0.5)
    remembering = [
        taken_in(f, boat(t)) for t, f in zip(later, followed(scene, [*instants_s, *later])[-20:], strict=True)
    ]
    alone = [taken_in(followed(scene, [t])[0], boat(t)) for t in later]
    assert sum(remembering) <= sum(alone) and sum(alone) > 5


def taken_in(tracks, place):
    """Whether the object at this position has members of both sources."""
    off = np.linalg.norm(tracks.state[:, :2] - place, axis=1)
    return bool(((off < 15.0) & (tracks.members >= 0).all(axis=1)).any())


def test_sources_without_plots_are_no_error():
    # Its first plot is after the last instant.
    plot = {"time_s": [90.0], "x_m": [0.0], "y_m": [0.0]}
    late = Feed.of(sensor("lidar", 2.0, 0.5), Reports.of("lidar", "table", plot))
    scene, _ = crossing(3, until_s=5.0)
    found = followed(Scene((late, scene.feeds[1])), [0.0, 1.0, 2.0])
    assert all(f.members.shape[1] == 2 and (f.members[:, 0] < 0).all() for f in found)
    none = followed(Scene((late,)), [0.0, 1.0])[-1]
    assert len(none) == 0 and none.identification is None


def test_unsupported_sources_are_refused_with_a_clear_message():
    scene, _ = crossing(1, until_s=5.0)
    now = scene.at(2.0, features=POSITION_AND_VELOCITY)
    tracker = PlotTracker()
    with pytest.raises(InputError, match="positions only; give"):
        tracker.advance(scene.at(2.0, features=POSITION))
    with pytest.raises(InputError, match="in the order of time"):
        tracker.advance(scene.at(1.0, features=POSITION_AND_VELOCITY), tracker.advance(now))
    with pytest.raises(InputError, match="all of them at every instant"):
        tracker.advance(Scene(scene.feeds[:1]).at(3.0, features=POSITION_AND_VELOCITY), tracker.advance(now))
    columns: dict[str, Any] = {"time_s": [0.0, 1.0], "x_m": [0.0, 1.0], "y_m": [0.0, 0.0], "track_id": ["a", "a"]}
    named = Feed.of(sensor("tracker", 2.0, 0.5), Reports.of("tracker", "table", columns))
    with pytest.raises(InputError, match="tracker names its objects"):
        tracker.advance(Scene((named,)).at(1.0, features=POSITION_AND_VELOCITY))
    refused: list[dict[str, Any]] = [{"correlation_s": -1.0}, {"min_q": 0.5}, {"lifetime_s": np.inf}]
    for wrong in refused:
        with pytest.raises(InputError, match=f"PlotTracker: .*{next(iter(wrong)).split('_')[0]}"):
            PlotTracker(**wrong)


def three_sources(rng):
    """Known objects and two sources, near each other in a plane."""
    known = Records.of(20.0 * rng.standard_normal((3, 2)), covariance=np.diag([9.0, 4.0]), source=KNOWN)
    looks = [
        Records.of(known.features[:2] + 3.0 * rng.standard_normal((2, 2)), sigma=2.0, source="lidar"),
        Records.of(np.vstack([known.features[0] + rng.standard_normal(2), [40.0, 0.0]]), sigma=3.0, source="radar"),
    ]
    return known, looks


def weight(rule, sources, row, region):
    """Weight of a set by the formulas, relative to its records each being false or a new object."""
    names, existence = ("lidar", "radar"), rule.existence
    log_j = joint_density(sources, np.array([row]), region).log_density[0]
    alone = [joint_density(sources, np.array([[k if t == s else -1 for t in range(3)]]), region).log_density[0]
             for s, k in enumerate(row)]  # fmt: skip
    out = np.exp(log_j)
    seen = [s for s in (1, 2) if row[s] >= 0]
    places = {s: rule.q[names[s - 1]][row[s]] for s in seen}
    if row[0] >= 0:
        q, r = rule.known_q[row[0]], existence[row[0]]
        out *= np.prod([1.0 - q[s - 1] if s in seen else q[s - 1] for s in (1, 2)]) * r / np.exp(alone[0])
        out /= 1.0 - r + r * q.prod()
    else:
        mean = np.exp(np.mean([np.log(q).sum() for q in places.values()]))
        out *= rule.density * mean * np.prod([(1.0 - q[s - 1]) / q[s - 1] for s, q in places.items()])
    for s, q in places.items():
        own = rule.density * q.prod() * (1.0 - q[s - 1]) / q[s - 1] * np.exp(alone[s])
        out /= own + rule.false[names[s - 1]]
    return out


@pytest.mark.parametrize("seed", range(3))
def test_weights_of_sets_agree_with_the_formulas(seed):
    rng = np.random.default_rng(seed)
    known, looks = three_sources(rng)
    region = Region(np.zeros(2), (100.0, 100.0))
    rule = BernoulliObjects(
        1e-4, ("lidar", "radar"), {name: rng.uniform(0.1, 0.9, (2, 2)) for name in ("lidar", "radar")},
        {"lidar": 1e-5, "radar": 3e-4}, rng.uniform(0.1, 0.9, 3), rng.uniform(0.1, 0.9, (3, 2)),
    )  # fmt: skip
    sources = [known, *looks]
    found = identify_many(sources, rule=rule, region=region)
    rows = np.full((len(found.sets), 3), -1)
    position = found.pooled.positions(found.sets.members)
    for u, given in enumerate(found.pooled.given):
        held = position[:, u] >= 0
        rows[held, given] = records_of(found.pooled.sources[u]).rows[position[held, u]]
    several = (rows >= 0).sum(axis=1) > 1
    assert several.sum() > 3
    expected = [weight(rule, sources, row, region) for row in rows[several].tolist()]
    np.testing.assert_allclose(found.sets.log_weight[several], np.log(expected), atol=1e-6)


def test_the_rule_is_refused_by_sequential_identification():
    _, looks = three_sources(np.random.default_rng(1))
    rule = BernoulliObjects(1e-4, ("lidar", "radar"), {}, {}, np.empty(0), np.empty((0, 2)))
    with pytest.raises(InputError, match="BernoulliObjects needs whole sets of records; use it in identify_many"):
        identify_sequentially(looks, rule=rule)


def test_without_known_objects_the_rule_is_the_poisson_field():
    rng = np.random.default_rng(3)
    _, looks = three_sources(rng)
    no_records = Records.of(np.empty((0, 2)), sigma=1.0, source=KNOWN)
    q = {name: np.tile([0.2, 0.4], (2, 1)) for name in ("lidar", "radar")}
    rule = BernoulliObjects(1e-4, ("lidar", "radar"), q, {"lidar": 1e-5, "radar": 2e-5}, np.empty(0), np.empty((0, 2)))
    ours = identify_many([no_records, *looks], rule=rule)
    field = identify_many(looks, rule=PoissonObjects(1e-4, (0.2, 0.4), (1e-5, 2e-5)))
    np.testing.assert_array_equal(ours.members.filled(-1)[:, 1:], field.members.filled(-1))
    np.testing.assert_allclose(ours.probability, field.probability, rtol=1e-9)


def objects(place, sigma_m=2.0, existence=0.9, hits=5.0):
    """BernoulliTable objects at places (m, 2), of two sources."""
    n = len(place)
    state = np.column_stack([place, np.zeros((n, 2))])
    covariance = np.tile(np.diag([sigma_m**2, sigma_m**2, 0.25, 0.25]), (n, 1, 1))
    return BernoulliTable.born(
        np.arange(1, n + 1), state, covariance, np.full(n, existence), np.broadcast_to(hits, (n, 2))
    )


def looked(before, seen, q=0.3, split=0.02):
    """BernoulliTable objects after scans of two sources."""
    seen = np.asarray(seen, float)
    same = np.full(seen.shape, q)
    after = before.after(Sighting(seen, np.ones(2), same))
    pairs = after.pairs_near()
    return after.with_separate_odds(pairs, seen, same, np.full(2, split), np.zeros((2, len(pairs[0]))), Tuning())


def test_existence_follows_bayes_and_misses_are_remembered():
    before = objects([[0.0, 0.0]], existence=0.5)
    missed = looked(before, [[0.0, 0.0]])
    assert missed.existence[0] == pytest.approx(0.5 * 0.09 / (0.5 + 0.5 * 0.09))
    assert looked(before, [[1.0, 0.0]]).existence[0] > 0.99
    q = missed.expected_q(np.full((1, 2), 0.3), scans=6.0, least=0.1)
    np.testing.assert_allclose(q, (6.0 * 0.3 + 1.0) / (6.0 + 1.0 + 5.0))
    assert (missed.aged(10.0, 60.0, 10.0).expected_q(np.full((1, 2), 0.3), 6.0, 0.1) != q).all()


def test_unresolved_objects_at_one_position_are_merged_and_resolved_ones_kept():
    twins = objects([[0.0, 0.0], [3.0, 1.0], [80.0, 0.0]])
    never, both = twins, twins
    for _ in range(4):
        never = looked(never, [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        both = looked(both, [[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]])
    assert never.merged(1e-4).number.tolist() == [1, 3]
    assert both.merged(1e-4).number.tolist() == [1, 2, 3]
    # Two detections of a source that splits hulls do not resolve two objects.
    hull = twins
    for _ in range(4):
        hull = looked(hull, [[1.0, 0.0], [1.0, 0.0], [1.0, 1.0]], split=0.7)
    assert len(hull.merged(1e-4)) < len(both)


def all_odds(table):
    """(m, m) log-odds that two objects are separate, 0 for those that were not near."""
    i, j = np.triu_indices(len(table), 1)
    out = np.zeros((len(table), len(table)))
    out[i, j] = out[j, i] = table.separate(i, j)
    return out


def merged_by_all_pairs(table, density_per_m2):
    """The numbers and odds of a table by comparing every two of its objects."""
    kept, odds_apart = list(range(len(table))), all_odds(table)
    state, covariance, number = table.state.copy(), table.covariance.copy(), table.number.copy()
    seen = table.existence * table.hits.sum(axis=1)
    while True:
        odds = np.full(odds_apart.shape, -np.inf)
        for i, j in combinations(kept, 2):
            delta, total = state[i] - state[j], covariance[i] + covariance[j]
            chi_sq = delta[:2] @ np.linalg.solve(total[:2, :2], delta[:2])
            if chi_sq > ChiSquare(DIFFERENT_QUANTILE).limit(2):
                odds_apart[i, j] = odds_apart[j, i] = 0.0
            if delta @ np.linalg.solve(total, delta) < ChiSquare(SAME_QUANTILE).limit(4):
                log_n = -0.5 * chi_sq - 0.5 * np.log(np.linalg.det(2.0 * np.pi * total[:2, :2]))
                odds[i, j] = log_n - np.log(density_per_m2) - odds_apart[i, j]
        i, j = np.unravel_index(int(odds.argmax()), odds.shape)
        if not odds[i, j] > MERGING_LOG_ODDS:
            return number[kept].tolist(), odds_apart[np.ix_(kept, kept)]
        best = max(i, j, key=lambda k: (seen[k], *state[k]))
        state[i], covariance[i], number[i] = state[best], covariance[best], min(number[i], number[j])
        seen[i] = 0.0  # no third one is so near
        kept.remove(int(j))


def test_objects_are_merged_as_by_comparing_every_two():
    """In a scene of 2 000 plots every two took 2 GB, and 3 s of the processor for each that was merged."""
    rng = np.random.default_rng(4)
    place = rng.uniform(0.0, 2_000.0, (30, 2))
    place = np.concatenate([place, place[:10] + rng.uniform(-4.0, 4.0, (10, 2))])
    table = objects(place, hits=rng.uniform(1.0, 5.0, (40, 2)))
    near = np.column_stack(table.pairs_near())
    table = replace(table, near=near, separate_log_odds=rng.uniform(-8.0, 8.0, len(near)))
    number, odds = merged_by_all_pairs(table, 1e-5)
    merged = table.merged(1e-5)
    assert merged.number.tolist() == number and 30 < len(number) < 40
    np.testing.assert_array_equal(all_odds(merged), odds)


def test_object_tables_can_be_split_and_joined():
    whole = objects(np.arange(10.0).reshape(5, 2))
    near = np.column_stack(np.triu_indices(5, 1))
    apart = replace(whole, near=near, separate_log_odds=np.arange(10.0))
    for a, b in near:
        pair = apart.take(np.array([b, a]))
        assert pair.near.tolist() == [[0, 1]] and pair.separate(np.array([0]), np.array([1])) == all_odds(apart)[a, b]
        assert pair.number.tolist() == [b + 1, a + 1]
    rejoined = apart.take(np.arange(5) < 2).with_(apart.take(np.arange(2, 5)))
    odds = all_odds(rejoined)
    assert rejoined.number.tolist() == whole.number.tolist() and not odds[:2, 2:].any()
    np.testing.assert_array_equal(odds[2:, 2:], all_odds(apart)[2:, 2:])


@pytest.mark.slow_after(1)
@pytest.mark.long
def test_two_that_a_radar_shows_as_one_stay_two_while_a_lidar_sees_both_at_times():
    """Two boats 15 m apart, 150 m from a radar that has the echo of one only, and from a lidar that misses each in 60 %
    of its scans: with the radar's resolution described, the other is not ended by echoes that it cannot have."""
    cell = Resolution(40.0, 2.5)

    def share_of_both(described: Resolution) -> float:
        both = []
        for seed in range(3):
            rng = np.random.default_rng(seed)
            tracks = [course((-60.0, 150.0 + y), (1.0, 0.0)) for y in (0.0, 15.0)]
            lidar = sensor("lidar", 2.0, 1.0, 0.6, 1.0)
            radar = replace(sensor("radar", 4.0, 1.0, 0.1, 1.0), resolution=described)
            feeds = plots(rng, lidar, tracks, 120.0), plots(rng, radar, tracks[:1], 120.0)
            times = np.arange(3.0, 118.0, 1.0)
            for t, found in zip(times, followed(Scene(feeds), times), strict=True):
                exist = np.vstack([found.state[found.existence > 0.5, :2], np.full((1, 2), 1e6)])
                off = np.linalg.norm(exist[:, None] - [track(t) for track in tracks], axis=2)
                if t > 15.0:
                    both.append(len(np.unique(off.argmin(axis=0))) == 2 and bool((off.min(axis=0) < 10.0).all()))
        return float(np.mean(both))

    without, with_ = share_of_both(Resolution(0.0, 0.0)), share_of_both(cell)
    assert with_ > without + 0.05, (without, with_)


def test_an_object_that_one_source_of_many_shows_in_clutter_is_found():
    # With ρ πσ² objects expected where others would have to miss it, each plot alone is of an object with p < 0.01.
    rng = np.random.default_rng(4)
    radar = sensor("radar", 4.0, 1.5, 0.2, 30.0)
    blind = [sensor(f"camera {k}", 4.0, 1.5, 0.5, 1.0) for k in range(3)]
    feeds = plots(rng, radar, [course((50.0, 20.0), (2.0, 0.0))], 60.0), *(plots(rng, b, [], 60.0) for b in blind)
    tracker, tracks, born, there_at = PlotTracker(correlation_s=0.0), None, [], []
    for t in np.arange(1.5, 59.0, 1.5).tolist():
        now = replace(Scene(feeds).at(t, features=POSITION_AND_VELOCITY), region=REGION, density=1e-9)
        tracks = tracker.advance(now, tracks)
        born += [tracks.existence[k] for k in np.flatnonzero(tracks.prior_of < 0)]
        near = np.linalg.norm(tracks.state[:, :2] - (50.0 + 2.0 * t, 20.0), axis=1) < 12.0
        there_at.append(tracks.existence[near].max(initial=0.0) > 0.5)
        assert not (tracks.existence[~near] > 0.9).any()
    assert max(born) < 0.01
    assert np.mean(there_at[15:]) > 0.7
