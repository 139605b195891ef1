"""Memory of track pairs: calibrated for correlated errors, bounded, and unchanged without new reports."""

from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import beside, describe, feed, straight, two_meet

from sameas.errors import InputError
from sameas.gate import Radius
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.many.pooled import pooled
from sameas.many.rules import PoissonObjects, pairs_of, terms_of
from sameas.picture import TrackMemory
from sameas.picture.error_correlation import ErrorCorrelation
from sameas.picture.id_swaps import Rivals
from sameas.picture.named_tracks import NamedTracks
from sameas.picture.picture import picture_states
from sameas.picture.previous_scans import FirstContact, PreviousScans
from sameas.picture.tables import Scan
from sameas.picture.track_pairs import TrackPairs
from sameas.picture.tuning import Tuning
from sameas.picture.watch import Watch
from sameas.prior import PerPair
from sameas.records import Records
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, Motion, SensorErrors, Timing


def couples_apart(seed, tau_s, n=300, box_m=600.0, looks=30):
    """Pairs of tracks, half of one object and half of two objects in convoy; their final log odds."""
    rng = np.random.default_rng(seed)
    times = np.arange(looks) * 3.0
    same = rng.random(n) < 0.5
    cell = np.stack(np.divmod(np.arange(n), 20), axis=1) * 20e3
    x, v = straight(cell, 4.0 * rng.standard_normal((n, 2)), times)
    apart = np.where(same[:, None], 0.0, rng.uniform(-box_m / 2, box_m / 2, (n, 2)))
    names = [str(k) for k in range(n)]
    one, two = describe("one", "tracks", 30.0), describe("two", "ais")
    sources = [feed(rng, one, times, x, v, tau_s[0], names), feed(rng, two, times[::3], (x + apart[:, None])[:, ::3],
               v[:, ::3], tau_s[1], names)]  # fmt: skip
    # The correlation times are known, and no error lasts. Pairs far apart are also compared until the end.
    tuning = Tuning(distant_chi_sq=np.inf, correlation_s=tau_s, lasting_shares=(0.0,))
    known, unknown = np.where(np.eye(2, dtype=bool), 0.0, -1e9)[:, None], np.full(2, np.nan)
    correlation = ErrorCorrelation(("one", "two"), known, known, unknown, unknown)
    scene, memory = Scene.of(sources), TrackMemory(tracks=NamedTracks(error_correlation=correlation))
    for time_s in times:
        scan = Scan.of(scene.at(time_s), tuning)
        memory = memory.advance(scan)
        if time_s == 0.0:
            memory = replace(memory, track_pairs=_all_pairs(scan, memory.tracks.track_of_record))
            # Tracks are numbered in the order of the scan.
            order = scan.track[:n].astype(int)
    return same[order], memory.rule().log_ratio, memory.track_pairs.log_now + 2.0 * np.log(box_m)


def _all_pairs(scan, number):
    """Pairs of tracks with equal ids."""
    n = len(scan) // 2
    a = np.arange(n)
    b = n + np.argsort(scan.track[n:].astype(int))[scan.track[:n].astype(int)]
    delta, spread = scan.state[a, :2] - scan.state[b, :2], scan.covariance[:, :2, :2]
    none = np.zeros_like(spread[a])
    return TrackPairs().with_(TrackPairs.of(number[a], number[b], delta, (spread[a], spread[b]), (none, none), 0.0))


def half_constant(seed, factors, n=60, every_s=10.0, instants=30):
    """Ships in pairs 70 m apart in two sources, whose errors are half constant and half new; ln r of every track with
    its ship's and with the neighbour's. factors : those on the errors that are believed, in turn."""
    rng = np.random.default_rng(seed)
    times, sigma = every_s * np.arange(instants), 30.0
    start = np.stack(np.divmod(np.arange(n) // 2, 10), axis=1) * 20e3
    start[1::2, 0] += 70.0
    x, v = straight(start, np.zeros((n, 2)), times)
    names, sources = [f"{k:03}" for k in range(n)], []
    for name in ("one", "two"):
        constant = sigma * np.sqrt(0.5) * rng.standard_normal((n, 1, 2))
        described = describe(name, "tracks", sigma, every_s)
        sources.append(feed(rng, described, times, x + constant, v, 0.0, names, sigma_m=sigma * np.sqrt(0.5)))
    scene, tuning = Scene.of(sources), Tuning()
    known = np.full((2, len(tuning.lasting_shares), len(tuning.correlation_s)), -1e9)
    known[:, tuning.lasting_shares.index(0.5), 0] = 0.0
    unknown = np.full(2, np.nan)
    memory = TrackMemory(
        tracks=NamedTracks(error_correlation=ErrorCorrelation(("one", "two"), known, known, unknown, unknown))
    )
    for k, time_s in enumerate(times):
        memory = memory.advance(memory.tracks.error_factors.applied(Scan.of(scene.at(time_s), tuning)))
        scan, number = memory.tracks.scan, memory.tracks.track_of_record
        if k == 0:
            a = np.repeat(np.arange(n), 2)
            b = n + np.stack([np.arange(n), np.arange(n) ^ 1], axis=1).ravel()
            delta, spread = scan.state[a, :2] - scan.state[b, :2], scan.covariance[:, :2, :2]
            lasting = memory.tracks.lasting
            pairs = TrackPairs.of(number[a], number[b], delta, (spread[a], spread[b]), (lasting[a], lasting[b]), 0.0)
            memory = replace(memory, track_pairs=TrackPairs().with_(pairs))
        of_range = np.full_like(memory.tracks.error_factors.by_range, factors[k % len(factors)])
        estimate = replace(memory.tracks.error_factors, by_range=of_range)
        memory = replace(memory, tracks=replace(memory.tracks, error_factors=estimate))
    pairs = memory.track_pairs
    log_ratio = pairs.log_ratio + pairs.log_reported
    name_of = scan.track[np.argsort(number)]
    right = name_of[pairs.first] == name_of[pairs.second]
    return log_ratio[right], log_ratio[~right]


def test_an_estimate_of_errors_that_changes_does_not_count_constant_errors_again():
    right, neighbour = half_constant(5, (1.0,))
    right_changing, neighbour_changing = half_constant(5, (1.0, 1.2))
    assert np.median(right_changing) == pytest.approx(np.median(right), abs=1.0)
    assert np.median(neighbour_changing) == pytest.approx(np.median(neighbour), abs=1.0)
    assert right_changing.mean() - neighbour_changing.mean() == pytest.approx(right.mean() - neighbour.mean(), abs=0.5)


def log_loss(log_odds, same):
    return float(np.mean(np.logaddexp(0.0, np.where(same, -log_odds, log_odds))))


@pytest.mark.slow
@pytest.mark.parametrize("tau_s", [(60.0, 600.0), (0.0, 0.0), (0.0, 600.0)])
def test_memory_is_calibrated_for_any_correlation_time(tau_s):
    same, past, now = (
        np.concatenate(column) for column in zip(*(couples_apart(k, tau_s) for k in range(3)), strict=True)
    )
    assert log_loss(now + past, same) < 0.8 * log_loss(now, same)
    p = 1.0 / (1.0 + np.exp(-(now + past)))
    for low, high in ((0.02, 0.5), (0.5, 0.98), (0.98, 1.0)):
        some = (p > low) & (p <= high)
        if some.sum() >= 15:
            error = np.sqrt(p[some].mean() * (1.0 - p[some].mean()) / some.sum())
            # Convoys are the worst case: the memory may be underconfident, never overconfident.
            assert p[some].mean() - same[some].mean() < 3.0 * error + 0.02 or p[some].mean() < 0.5


@pytest.mark.slow
def test_memory_is_bounded_by_the_reliability_of_track_ids():
    scene, times = two_meet(0, 200.0)
    memory, tuning = TrackMemory(), Tuning(distant_chi_sq=np.inf, report_reassigned=0.01)
    for time_s in times:
        now = scene.at(time_s)
        memory = memory.advance(Scan.of(now, tuning))
        found = identify_many(now.sources, rule=now.rule() + memory.rule(), region=now.region)
        memory = memory.with_pairs(found.pooled)
        log_ratio, bound = np.asarray(memory.rule().log_ratio), np.log(0.99 / 0.01) + 1e-9
        assert log_ratio.max(initial=0.0) <= bound and log_ratio.min(initial=0.0) >= -2.0 * bound
    # Who met and went on is another's: less so than who stays together by as much as a look's name is worth.
    log_ratio = np.asarray(memory.rule().log_ratio)
    assert log_ratio.max() > 0.5 and log_ratio.max() - log_ratio.min() > 0.9 * np.log(0.99 / 0.01)


def test_repeated_reports_are_no_evidence():
    scene, _ = two_meet(1, 200.0)
    memory = TrackMemory()
    for time_s in (0.0, 10.0, 20.0):
        now = scene.at(time_s)
        memory = memory.advance(Scan.of(now))
        memory = memory.with_pairs(
            identify_many(now.sources, rule=now.rule() + memory.rule(), region=now.region).pooled
        )
    log_ratio = np.asarray(memory.rule().log_ratio) + memory.track_pairs.log_now
    for time_s in (21.0, 24.0, 29.0):
        memory = memory.advance(Scan.of(scene.at(time_s)))
        # The sum of present and past evidence is unchanged; the reports have only aged.
        np.testing.assert_allclose(
            np.asarray(memory.rule().log_ratio) + memory.track_pairs.log_now, log_ratio, atol=1e-9
        )


def test_a_track_that_jumps_starts_a_new_memory():
    rng = np.random.default_rng(2)
    times = np.arange(0.0, 61.0, 10.0)
    x, v = straight([[0.0, 0.0]], [[3.0, 0.0]], times)
    jumped = x.copy()
    jumped[:, 4:] += 5000.0
    radar, ais = describe("radar", "tracks"), describe("ais", "ais")
    scene = Scene.of([feed(rng, radar, times, jumped, v, 60.0, ["7"]), feed(rng, ais, times, x, v, 600.0, ["a"])])
    memory = TrackMemory()
    for time_s in times:
        now = scene.at(time_s)
        memory = memory.advance(Scan.of(now))
        if time_s == 40.0:
            assert not len(memory.track_pairs)
        memory = memory.with_pairs(identify_many(now.sources, rule=now.rule(), region=now.region).pooled)
        assert len(memory.track_pairs) == (time_s < 40.0)


def test_records_without_ids_have_no_memory():
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 31.0, 10.0)
    x, v = straight([[0.0, 0.0], [500.0, 0.0]], [[3.0, 0.0]] * 2, times)
    radar, ais = describe("radar", "marine radar"), describe("ais", "ais")
    scene, memory = (
        Scene.of([feed(rng, radar, times, x, v, 0.0), feed(rng, ais, times, x, v, 600.0, ["a", "b"])]),
        TrackMemory(),
    )
    for time_s in times:
        now = scene.at(time_s)
        memory = memory.advance(Scan.of(now))
        memory = memory.with_pairs(identify_many(now.sources, rule=now.rule(), region=now.region).pooled)
    assert not len(memory.track_pairs) and memory.tracks.track_of_record.tolist() == [-1, -1, 0, 1]


def test_memory_is_symmetric_in_a_pair():
    one = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="one")
    two = Records.of([[5.0, 0.0], [8.0, 0.0]], sigma=5.0, source="two")
    memory = PreviousScans({"one": [3, 4], "two": [7, -1]}, first=[3, 4], second=[7, 7], log_ratio=[5.5, -2.0])
    pairs, turned = Radius(5.0)(one, two), Radius(5.0)(two, one)
    by_pair = {(int(i), int(j)): v for i, j, v in zip(pairs.i, pairs.j, memory(pairs).log_ratio, strict=True)}
    again = {(int(j), int(i)): v for i, j, v in zip(turned.i, turned.j, memory(turned).log_ratio, strict=True)}
    assert by_pair == again == {(0, 0): 5.5, (1, 0): -2.0, (0, 1): 0.0, (1, 1): 0.0}
    assert memory(pairs).informative.sum() == 2


def test_invalid_memory_settings_are_refused():
    with pytest.raises(InputError, match="first < second"):
        PreviousScans({}, [2], [1], [0.5])
    with pytest.raises(InputError, match="once, in ascending order"):
        PreviousScans({}, [1, 1], [2, 2], [0.5, 0.5])
    scene, _ = two_meet(1, 200.0)
    with pytest.raises(InputError, match="instants in the order of time"):
        TrackMemory().advance(Scan.of(scene.at(20.0))).advance(Scan.of(scene.at(10.0)))


def two_tracks(seed, same, looks=6, sigma=(20.0, 8.0)):
    """Positions (2, looks, 2) of two tracks of moored objects, with errors of which half lasts, and each one's R."""
    rng = np.random.default_rng(seed)
    d = np.zeros(2) if same else rng.normal(0.0, 30.0, 2)
    lasting = np.sqrt(0.5) * rng.standard_normal((2, 1, 2))
    x = np.asarray(sigma)[:, None, None] * (lasting + np.sqrt(0.5) * rng.standard_normal((2, looks, 2)))
    x[1] += d
    return x


def brute_force(x, sigma, rho, together):
    """ln p of all reports but for a constant: both objects at one unknown place (or d apart)."""
    looks = x.shape[1]
    e = np.arange(looks)
    blocks = [s**2 * (0.5 + 0.5 * rho ** np.abs(e[:, None] - e)) for s in sigma]
    covariance = np.zeros((2 * looks, 2 * looks))
    covariance[:looks, :looks], covariance[looks:, looks:] = blocks
    wide = 1e5**2
    covariance += wide
    if not together:
        covariance[looks:, looks:] += wide
    values = x.reshape(2 * looks, 2)
    return -0.5 * (
        np.einsum("ka,kl,la->", values, np.linalg.inv(covariance), values)
        + 2 * np.linalg.slogdet(covariance)[1]
        + 2 * 2 * looks * np.log(2.0 * np.pi)
    )


@pytest.mark.parametrize("tau_s", [0.0, 15.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_of_a_pair_is_the_joint_density_of_all_its_reports(seed, tau_s):
    sigma, times = (20.0, 8.0), np.arange(6) * 10.0
    x = two_tracks(seed, same=seed % 2 == 0)
    still = Motion(1e-12, 1e-3)
    errors = [SensorErrors(position_m=s, speed_m_per_s=1e-6, course_deg=1e-3, extent_m=0.0) for s in sigma]
    sources = []
    for name, own, error in zip(("one", "two"), x, errors, strict=True):
        columns = {
            "time_s": times,
            "x_m": own[:, 0],
            "y_m": own[:, 1],
            "vx_m_per_s": 0 * times,
            "vy_m_per_s": 0 * times,
        }
        described = Description(name, "tracks", motion=still, errors=error, timing=Timing(10.0, 0.0, 0.0))
        sources.append((described, Reports.of(name, "table", columns | {"track_id": ["7"] * len(times)})))
    # Half of the error is correlated, with τ = tau_s; convoys are certain and swaps impossible.
    tuning = Tuning(lasting_shares=(0.5,), correlation_s=(tau_s,), convoy_log_odds=1e9, report_reassigned=1e-300)
    scene, memory = Scene.of(sources), TrackMemory()
    for time_s in times:
        scan = Scan.of(scene.at(time_s), tuning)
        memory = memory.advance(scan)
        if time_s == 0.0:
            state, covariance, lasting = scan.state[:, :2], scan.covariance[:, :2, :2], memory.tracks.lasting
            fresh = TrackPairs.of(
                memory.tracks.track_of_record[:1], memory.tracks.track_of_record[1:], (state[:1] - state[1:]),
                (covariance[:1], covariance[1:]), (lasting[:1], lasting[1:]), time_s,
            )  # fmt: skip
            memory = replace(memory, track_pairs=replace(fresh, log_convoy=np.array([1e9])))
    rho = np.exp(-10.0 / tau_s) if tau_s else 0.0
    # Any distance within an area of (1e5 m)²; the density of a pair is per m².
    due = brute_force(x, sigma, rho, True) - brute_force(x, sigma, rho, False) - np.log(2.0 * np.pi * 1e10)
    pairs = memory.track_pairs
    assert pairs.log_ratio[0] + pairs.log_reported[0] == pytest.approx(due, abs=1e-3)


@pytest.mark.slow
def test_pairs_that_separated_long_ago_are_forgotten():
    # Four ships on one line, two in each direction: all meet within four minutes.
    rng, times = np.random.default_rng(8), np.arange(0.0, 501.0, 20.0)
    start = np.column_stack([[0.0, 2000.0, 400.0, 2400.0], np.zeros(4)])
    x, v = straight(start, np.column_stack([[6.0, -6.0, 6.0, -6.0], np.zeros(4)]), times)
    names = [str(k) for k in range(4)]
    scene = Scene.of([feed(rng, describe(name, "tracks", period_s=20.0), times, x, v, 0.0, names) for name in "ab"])
    counts = []
    for timeout_s in (150.0, 1e9):
        watch = Watch(tuning=Tuning(pair_timeout_s=timeout_s))
        for time_s in times:
            state = watch.advance(scene.at(time_s))
            watch = state.watch
        counts.append(len(watch.memory.track_pairs) + len(watch.memory.track_pairs.distant))
        shown = np.append(state.scan.track, "")[state.members]
        assert sorted(shown.tolist()) == [[k, k] for k in names[: len(shown)]]
    # The two tracks of each ship, and all pairs that have met.
    assert counts[0] == 4 < counts[1]


@pytest.mark.slow
def test_memory_of_separated_tracks_counts_when_they_meet_again():
    # Two ships pass, turn around a kilometre apart, and pass again.
    rng, times = np.random.default_rng(3), np.arange(0.0, 601.0, 10.0)
    way = 6.0 * np.minimum(times, 600.0 - times) - 600.0
    x = np.stack([np.column_stack([side * way, np.full(len(times), side * 40.0)]) for side in (1.0, -1.0)])
    v = np.gradient(x, 10.0, axis=1)
    scene = Scene.of([feed(rng, describe(name, "tracks"), times, x, v, 20.0, ["0", "1"]) for name in "ab"])
    pairs, together = [], []
    for tuning in (Tuning(), Tuning(distant_chi_sq=np.inf)):
        watch = Watch(tuning=tuning)
        for time_s in times:
            state = watch.advance(scene.at(time_s))
            watch = state.watch
            shown = np.append(state.scan.track, "")[state.members]
            together.append(float(state.probability[(shown == "0").all(axis=1)].sum()))
            pairs.append(len(watch.memory.track_pairs))
    (some, every), (ours, theirs) = np.reshape(pairs, (2, -1)), np.reshape(together, (2, -1))
    assert some[35] == 2 < every[35] == 4 == some[50] and theirs.min() > 0.9
    np.testing.assert_allclose(ours, theirs, atol=0.01)


@pytest.mark.parametrize(("gap_s", "known"), [(40.0, True), (200.0, False)])
def test_a_track_that_a_source_misses_for_a_while_keeps_its_history(gap_s, known):
    """A boat that had moored at a turbine was the turbine after four scans in which the radar missed that."""
    rng, times = np.random.default_rng(3), np.arange(0.0, 601.0, 2.0)
    x, v = straight(10e3 * np.arange(20.0)[:, None] * [0.0, 1.0], np.full((20, 2), 4.0), times)
    names = [str(k) for k in range(20)]
    one, two = (feed(rng, describe(name, "tracks", period_s=2.0), times, x, v, 0.0, names) for name in "ab")
    seen = (two[1].track_id != "0") | (two[1].time_s < 300.0) | (two[1].time_s >= 300.0 + gap_s)
    two = two[0], two[1].where(np.flatnonzero(seen))
    scene, watch = Scene.of([one, two]), Watch()
    log_ratio = {}
    for time_s in np.arange(0.0, 300.0 + gap_s + 1.0, 10.0):
        watch = watch.advance(scene.at(time_s)).watch
        number = [watch.memory.tracks.by_name[name]["0"] for name in "ab"]
        pairs = watch.memory.track_pairs
        [of_pair] = [pairs.log_ratio[(pairs.first == min(number)) & (pairs.second == max(number))]]
        log_ratio[time_s] = of_pair.tolist()
    # Errors are new in each report: each instant adds evidence.
    assert log_ratio[290.0][0] > 2.0 and log_ratio[290.0 + gap_s] == []
    assert log_ratio[300.0 + gap_s] == (pytest.approx(log_ratio[290.0], abs=2.0) if known else [0.0])


def p_one(scene, every_s=30.0, watch=None):
    """(n,) the probability that "a0" and "r1" are one object at instants of the scene's second half."""
    out = []
    for state in picture_states(scene, np.arange(30.0, scene.span_s[1], every_s), watch or Watch()):
        names = np.append(state.scan.track, "")[state.members]
        first = (names == "a0").any(axis=1)
        together = first & (names == "r1").any(axis=1)
        # If separate, at most the remaining probability of the ship.
        out.append(float(state.probability[together][0] if together.any() else 1.0 - state.probability[first][0]))
    return np.array(out[len(out) // 2 :])


@pytest.mark.slow
def test_a_lasting_separation_beyond_correlated_errors_is_two_objects():
    # One scan cannot distinguish 75 m from 0 with σ = 31 m; minutes can, at steps longer than its errors last.
    watch = Watch(tuning=Tuning(memory_every_s=30.0))
    assert np.mean([p_one(beside(seed, 75.0), watch=watch) for seed in (2, 3, 4)]) < 0.25


def test_reports_between_two_instants_enter_the_memory_in_steps():
    scene = beside(2, 60.0, minutes=2.0)
    watch = Watch().advance(scene.at(30.0)).watch
    found = watch.at(scene, 60.0)
    by_hand = watch.passed(scene.at(40.0)).passed(scene.at(50.0)).advance(scene.at(60.0))
    alone = watch.advance(scene.at(60.0))
    pairs = [state.watch.memory.track_pairs for state in (found, by_hand, alone)]
    np.testing.assert_array_equal(pairs[0].log_ratio, pairs[1].log_ratio)
    np.testing.assert_array_equal(found.probability, by_hand.probability)
    assert (pairs[0].log_ratio != pairs[2].log_ratio).any()
    # Between two steps it stays, and the present positions count once.
    between = found.watch.at(scene, 63.0)
    assert between.watch.memory.tracks.instant_s == 60.0 and between.now.instant_s == 63.0
    with pytest.raises(InputError, match="the picture is at 63 s and was given 62 s"):
        between.watch.advance(scene.at(62.0))


def test_tracks_that_begin_between_two_steps_of_the_memory_keep_their_numbers():
    rng, times = np.random.default_rng(1), np.arange(0.0, 61.0, 1.0)
    starts = (0, 12, 13, 17, 25)
    x = np.stack([np.column_stack([4.0 * times, np.full(len(times), 900.0 * k)]) for k in range(len(starts))])
    v = np.gradient(x, 1.0, axis=1)
    whole = feed(rng, describe("a", "tracks"), times, x, v, 20.0, [f"t{k}" for k in range(len(starts))])
    begun = np.array([t >= starts[int(name[1:])] for t, name in zip(whole[1].time_s, whole[1].track_id, strict=True)])
    other = feed(rng, describe("b", "tracks"), times, x[:1], v[:1], 20.0, ["0"])
    scene = Scene.of([(whole[0], whole[1].where(np.flatnonzero(begun))), other])
    numbers, stepped = {}, set()
    for state in picture_states(scene, times, Watch()):
        assert isinstance(state.watch, Watch)
        stepped.add(state.watch.memory.tracks.instant_s)
        objects = state.watch.objects
        for number, k in zip(objects.number.tolist(), objects.detection.tolist(), strict=True):
            if k >= 0:
                for track in state.scan.track[state.members[k][state.members[k] >= 0]]:
                    numbers.setdefault(track, set()).add(number)
    assert sorted(stepped) == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]
    assert set(numbers) == {"0", *(f"t{k}" for k in range(len(starts)))}
    assert all(len(found) == 1 for found in numbers.values()), numbers


@pytest.mark.long
def test_tracks_that_begin_and_end_between_two_steps_of_the_memory_are_forgotten():
    """A false track of six seconds, every 20 s another: their ids time out, and they count as short tracks."""
    rng, times = np.random.default_rng(1), np.arange(0.0, 241.0, 1.0)
    x = np.stack([np.column_stack([4.0 * times, np.full(len(times), 900.0 * k)]) for k in range(13)])
    v = np.gradient(x, 1.0, axis=1)
    description, reports = feed(rng, describe("a", "tracks"), times, x, v, 20.0, [f"t{k}" for k in range(13)])
    k = np.array([int(name[1:]) for name in reports.track_id])
    since = reports.time_s - 20.0 * k + 18.0
    lives = (k == 0) | (since >= 1.0) & (since < 7.0)
    other = feed(rng, describe("b", "tracks"), times, x[:1], v[:1], 20.0, ["0"])
    scene = Scene.of([(description, reports.where(np.flatnonzero(lives))), other])
    most, states = 0, picture_states(scene, times, Watch(tuning=Tuning(id_timeout_s=30.0)))
    for state in states:
        assert isinstance(state.watch, Watch)
        tracks = state.watch.memory.tracks
        most = max(most, sum(map(len, tracks.by_name.values())))
    assert tracks.n_numbers == 14 and most <= 5
    every_second = Watch(tuning=Tuning(id_timeout_s=30.0, memory_every_s=1.0))
    whole = list(picture_states(scene, times, every_second))[-1].watch
    assert isinstance(whole, Watch)
    found, expected = (watch.memory.existence.mixture for watch in (state.watch, whole))
    np.testing.assert_allclose(found.share, expected.share, rtol=1e-6)
    np.testing.assert_allclose(found.false_s, expected.false_s, rtol=1e-6)


@pytest.mark.slow
def test_errors_measured_on_other_tracks_override_stated_ones():
    # 30 m are stated for both, other tracks show 8 m: 100 m apart are two objects.
    p = p_one(beside(2, 100.0, sigma_m=(8.0, 8.0), stated_m=(30.0, 30.0), others=12))
    assert p[-5:].mean() < 0.5


@pytest.mark.slow
def test_a_ship_seen_by_both_sources_stays_one_object_for_any_stated_errors():
    for stated_m in ((30.0, 8.0), (45.0, 15.0)):
        assert p_one(beside(2, 0.0, stated_m=stated_m, radar_sees_it=True)).min() > 0.999


def abreast(seed, gap_m=40.0, swaps=0.0):
    """Five pairs of ships ``gap_m`` abreast before two trackers of 25 m and AIS of 8 m; the first tracker swaps the ids
    of each pair with the probability ``swaps`` per report."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 401.0, 10.0)
    lead = rng.uniform(0.0, 3000.0, (5, 2))
    v = np.repeat(rng.normal(0.0, 2.0, (5, 2)), 2, axis=0)
    aside = np.column_stack([-v[:, 1], v[:, 0]]) / np.hypot(*v.T)[:, None]
    x, velocity = straight(np.repeat(lead, 2, axis=0) + gap_m * (np.arange(10) % 2)[:, None] * aside, v, times)
    names = [str(k) for k in range(10)]
    mmsi = {"mmsi": [f"23500000{name}" for name in names]}
    swapped = np.repeat(np.cumsum(rng.random((5, len(times))) < swaps, axis=1) % 2 if swaps else 0 * x[::2, :, 0], 2, 0)
    west = np.where(swapped[..., None] > 0, x[np.arange(10) ^ 1], x)
    sources = [
        feed(rng, describe("west", "tracks", 25.0), times, west, velocity, 0.0, names),
        feed(rng, describe("east", "tracks", 25.0), times, x, velocity, 0.0, names),
        feed(rng, describe("ais", "ais", 8.0), times, x, velocity, 0.0, names, mmsi),
    ]
    return Scene.of(sources), times


@pytest.mark.slow
def test_trackers_without_swaps_are_not_suspected_of_them():
    right, rates = [], []
    for seed in range(3):
        (scene, times), watch = abreast(seed), Watch()
        for time_s in times:
            state = watch.advance(scene.at(time_s))
            watch = state.watch
            names = np.append(state.scan.track, "")[state.members]
            if state.now.instant_s >= 300.0:
                right += ((names == names[:, :1]).all(axis=1) * state.probability).tolist()
        rates.append(watch.memory.swaps.rate(np.arange(2)))
    # By one ln r for all rates, that of the mean one, they came out as 0.004 to 0.012, once as 0.3.
    assert np.max(rates) < 0.003
    assert np.mean(right) > 0.85


@pytest.mark.slow
def test_two_tracks_of_a_wrong_ship_count_twice_against_it():
    # Two ships √10 σ of a tracker apart, each with a track of three sources, one of them 4 times as precise; ln r is
    # that of noiseless mean offsets.
    numbers = {name: [k, k + 1] for name, k in (("ais", 0), ("east", 2), ("west", 4))}
    precision = {"ais": 16.0, "east": 1.0, "west": 1.0}
    source = {track: name for name, tracks in numbers.items() for track in tracks}
    pairs = [(a, b) for a in range(6) for b in range(a + 1, 6) if source[a] != source[b]]
    w = np.array([[precision[source[track]] for track in pair] for pair in pairs])
    apart = np.array([(a - b) % 2 for a, b in pairs])
    log_ratio = 4.0 - 5.0 * apart * w.prod(axis=1) / w.sum(axis=1)
    first, second = np.array(pairs).T
    one, other = (np.array([list(numbers).index(source[track]) for track in side]) for side in (first, second))
    level = Rivals.of(first, second, one, other).level(log_ratio, np.ones(len(pairs), bool))
    assert level.tolist() == pytest.approx([4.0] * len(pairs))
    rule = PreviousScans(numbers, first, second, log_ratio, level, w.sum(axis=1))
    rng = np.random.default_rng(1)
    sources = [Records.of(rng.normal(size=(2, 2)), sigma=5.0, source=name) for name in numbers]
    together = pooled(sources, Radius(1e3))
    terms = terms_of(PoissonObjects(1e-3, 0.2) + rule, PerPair(0.0), together)
    track = [numbers[s.source][row] for s in map(records_of, together.sources) for row in s.rows]

    def history(of):
        """Σ of the memory of the set of one track per source."""
        records = np.sort([track.index(k) for k in of])[None]
        return float(terms.by_pair_of(pairs_of(together, records))[0])

    for wrong in ([0, 2, 5], [0, 3, 4], [0, 3, 5]):
        # ½ χ² of the set's positions about their weighted mean.
        at = np.array([k % 2 for k in wrong])
        weight = np.array([precision[source[k]] for k in wrong])
        joint = 5.0 * (weight * (at - np.average(at, weights=weight)) ** 2).sum()
        assert history([0, 2, 4]) - history(wrong) == pytest.approx(joint)


@pytest.mark.slow
def test_swaps_of_ships_abreast_are_found_over_many_reports():
    rates = []
    for seed in range(3):
        (scene, times), watch = abreast(seed, swaps=0.1), Watch()
        for time_s in times:
            watch = watch.advance(scene.at(time_s)).watch
        rates.append(watch.memory.swaps.rate(np.arange(2)))
    west, east = np.array(rates).T
    assert np.median(west) > 0.02
    assert np.median(east) < 0.5 * np.median(west)


def overflight(seed, kinds=("ais", "ads-b"), ids=("mmsi", "icao"), sigma_m=(5.0, 30.0), n=20):
    """Ships that report every 10 s, and as many aircraft at 150 m/s, each of which passes over one."""
    rng, plane = np.random.default_rng(seed), LocalPlane(50.0, -1.0)
    ship, v, over = rng.uniform(-15e3, 15e3, (n, 2)), rng.uniform(-4.0, 4.0, (n, 2)), rng.uniform(20.0, 60.0, n)
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    u = 150.0 * np.column_stack([np.sin(angle), np.cos(angle)])
    sources = []
    for k, (velocity, every_s) in enumerate(((v, 10.0), (u, 1.0))):
        time_s, number = (each.ravel() for each in np.meshgrid(np.arange(0.0, 71.0), np.arange(n), indexing="ij"))
        sent = (time_s + number) % every_s == 0.0
        time_s, number = time_s[sent], number[sent]
        place = ship[number] + time_s[:, None] * velocity[number] + over[number, None] * (v - velocity)[number]
        lat, lon = plane.to_geodetic(place + sigma_m[k] * rng.standard_normal(place.shape))
        speed, course = np.hypot(*velocity[number].T), np.degrees(np.arctan2(*velocity[number].T)) % 360.0
        names = np.array([f"{235_000_000 + i}" if ids[k] == "mmsi" else f"{0x400000 + i:06x}" for i in number], object)
        columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "speed_m_per_s": speed, "course_deg": course}
        motion = Motion(4.0, 150.0) if k else Motion(0.01, 8.0)
        errors = SensorErrors(position_m=76.0 if k else 18.0, speed_m_per_s=1.5 if k else 0.3, course_deg=1.0)
        described = Description(f"source {k}", kinds[k], motion=motion, errors=errors, timing=Timing(every_s, 0.0, 0.0))
        sources.append((described, Reports.of(f"source {k}", "table", columns | {ids[k]: names})))
    return Scene.of(sources, plane)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [("ais", "ads-b"), ("tracks", "tracks")])
def test_an_aircraft_over_a_ship_does_not_join_it(kinds):
    ids = ("mmsi", "icao") if kinds[0] == "ais" else ("track_id", "track_id")
    scene = overflight(1, kinds, ids)
    joined = [
        float(p)
        for state in picture_states(scene, np.arange(10.0, 71.0), Watch())
        for p in state.probability[(state.members >= 0).all(axis=1)]
    ]
    assert not joined


def test_velocities_of_a_new_pair_count_if_they_differ_and_never_join_it():
    scan = Scan.of(overflight(2, n=3).at(10.0))
    state = scan.state.copy()
    state[1, 2:] = state[0, 2:] + 6.0 * np.sqrt(2.0 * scan.covariance[0, 2:, 2:].diagonal()) * [1.0, 0.0]
    first = FirstContact(replace(scan, state=state), {}, TrackMemory().rule(), np.zeros(0, bool), NamedTracks())
    # The same velocity, one that is 6σ wrong, and that of an aircraft.
    log_ratio = first._by_velocity(np.array([0, 0, 0]), np.array([0, 1, 3]))
    assert log_ratio[0] == 0.0 and -7.0 < log_ratio[1] < -1.0
    assert log_ratio[2] == pytest.approx(2.0 * np.log(1e-4))
    assert first._by_target(np.array([0, 0]), np.array([1, 3])) == pytest.approx([0.0, np.log(1e-3)])


def at_turbines(seed, apart_m=(12.0, 0.0), way_m=2000.0):
    """A boat that comes from ``way_m`` to the second of five turbines and ends ``apart_m`` from it. She is in the AIS
    alone: the radar tracks the turbines."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 700.0, 10.0)
    turbines = np.array([[900.0 * k, 0.0] for k in range(5)])
    still = np.zeros((5, len(times), 2))
    left = np.maximum(way_m - 6.0 * times, 0.0)
    boat = turbines[1] + np.array(apart_m) + left[:, None] * [0.6, 0.8]
    speed = np.where(left > 0.0, -6.0, 0.0)[:, None] * [0.6, 0.8]
    sources = [
        feed(rng, describe("radar", "tracks"), times, turbines[:, None] + still, still, 30.0, list("01234")),
        feed(rng, describe("ais", "ais", 10.0), times, boat[None], speed[None], 300.0, ["a"], {"mmsi": ["235000000"]}),
    ]
    return Scene.of(sources), times


@pytest.mark.parametrize("way_m", [2000.0, 0.0])
def test_a_boat_that_comes_and_moors_at_a_turbine_is_not_the_turbine(way_m):
    """One that was always there may be: it is the turbine itself."""
    together = []
    for seed in range(4):
        scene, times = at_turbines(seed, way_m=way_m)
        states = list(picture_states(scene, times))
        together += [(state.members >= 0).all(axis=1).any() for state in states[-30:]]
    assert np.mean(together) < 0.4 if way_m else np.mean(together) > 0.9


def test_an_offset_that_is_subtracted_is_no_way_of_any_track():
    scene, times = at_turbines(0)
    watch = Watch()
    for time_s in times[times <= 340.0]:
        watch = watch.at(scene, time_s).watch
    tracks = watch.memory.tracks
    source = tracks.scan.source[tracks.place]
    turbines = tracks.place[source == 0]
    boat = np.repeat(tracks.place[source == 1], len(turbines))
    assert (tracks.log_met(boat, turbines, 1e-6) < -10.0).all()
    assert (watch.displaced().memory.tracks.log_met(boat, turbines, 1e-6) == 0.0).all()


@pytest.mark.parametrize(("kind", "beside", "jump_m", "restarts"), [
    ("ads-b", None, 0.0, False), ("ads-b", None, 2e4, True), ("ads-b", "tracks", 0.0, True), ("ais", None, 0.0, True),
    ("tracks", None, 0.0, True),
])  # fmt: skip
def test_an_aircraft_that_circles_is_not_another_one_where_all_name_themselves(kind, beside, jump_m, restarts):
    """No motion model predicts a glider in a thermal: her track began anew at each step of the memory, and gliders of
    two sources were paired by each instant alone. A radar's track begins anew by the same motion, and a history that
    only the other one kept was evidence for two: boats with AIS in tight turns were two in one of two instants."""
    rng, times = np.random.default_rng(4), np.arange(0.0, 60.0, 10.0)
    angle = 0.2 * times
    x = 200.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None]
    v = 40.0 * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)[None]
    x[:, 4:] += [jump_m, 0.0]
    sources = [
        replace(describe(name, one, 4.0), motion=Motion(4.0, 150.0))
        for name, one in (("one", kind), ("two", beside))
        if one
    ]
    scene = Scene.of([feed(rng, described, times, x, v, 10.0, ["a"]) for described in sources])
    tracks, restarted = NamedTracks(), []
    for time_s in times:
        tracks, step = tracks.advance(Scan.of(scene.at(time_s), Tuning()))
        restarted.append(len(step.restarted) > 0)
    assert any(restarted) == restarts
    assert jump_m == 0.0 or restarted == [False] * 4 + [True, False]
