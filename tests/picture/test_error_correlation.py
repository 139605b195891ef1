"""The correlation time of errors is learned from a source's own tracks, for any assumed process noise."""

from dataclasses import replace

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight

from sameas.gaussian import Gaussian, log_density, mahalanobis_sq, propagated
from sameas.kernels.kalman import add_evidence, correlated_shifts, update_in_plane
from sameas.picture import TrackMemory, Watch
from sameas.picture.error_correlation import CORRELATIONS, ErrorCorrelation
from sameas.picture.tables import Scan
from sameas.picture.tuning import DEFAULT_TUNING
from sameas.tracks.scene import Scene


def learned(tau_s, kind="tracks", seed=1, looks=25, every_s=10.0):
    """The correlation of errors at the looks' interval, as learned of 40 tracks whose errors last for tau_s."""
    rng = np.random.default_rng(seed)
    times = np.arange(looks) * every_s
    x, v = straight(rng.uniform(-9e3, 9e3, (40, 2)), 4.0 * rng.standard_normal((40, 2)), times)
    scene = Scene.of([feed(rng, describe("one", kind), times, x, v, tau_s, [str(k) for k in range(40)])])
    memory = TrackMemory()
    for time_s in times:
        memory = memory.advance(Scan.of(scene.at(time_s)))
    return float(memory.tracks.error_correlation.correlation(np.zeros(1, np.int64), np.array([every_s]))[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tracks", "ais"])
@pytest.mark.parametrize("tau_s", [0.0, 12.0, 180.0])
def test_the_correlation_is_learned_for_any_assumed_kind(kind, tau_s):
    true = np.exp(-10.0 / tau_s) if tau_s else 0.0
    assert abs(learned(tau_s, kind) - true) < 0.12


def test_before_any_scan_the_default_of_the_kind_is_used():
    rng = np.random.default_rng(2)
    x, v = straight([[0.0, 0.0]], [[4.0, 0.0]], np.zeros(1))
    scene = Scene.of([feed(rng, describe(name, name), np.zeros(1), x, v, 0.0, ["7"]) for name in ("ais", "air radar")])
    lasting = TrackMemory().advance(Scan.of(scene.at(0.0))).tracks.error_correlation
    ais, radar = (
        lasting.correlation(np.array([lasting.names.index(n)]), np.array([10.0]))[0] for n in ("ais", "air radar")
    )
    assert ais > 0.8 and radar < ais - 0.1


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_correlations_are_learned_from_certain_pairs(share):
    rng = np.random.default_rng(3)
    times = np.arange(25) * 10.0
    x, v = straight(rng.uniform(-9e3, 9e3, (60, 2)), 4.0 * rng.standard_normal((60, 2)), times)
    names, sources = [str(k) for k in range(60)], []
    for name in ("one", "two"):
        lasting = 20.0 * np.sqrt(share) * rng.standard_normal((60, 1, 2))
        _, reports = feed(rng, describe(name, "tracks", 20.0 * np.sqrt(1.0 - share)), times, x + lasting, v, 0.0, names)
        sources.append((describe(name, "tracks"), reports))
    watch = Watch()
    for time_s in times:
        watch = watch.advance(Scene.of(sources).at(time_s)).watch
    found = watch.memory.tracks.error_correlation.lasting(np.arange(2))
    assert np.abs(found - share).max() < 0.15


@pytest.mark.parametrize("d", [4, 8])
@pytest.mark.parametrize("way", ["interpreted", "compiled"])
def test_an_update_is_the_kalman_update(d, way):
    rng = np.random.default_rng(d)
    root, noise_root = rng.normal(size=(60, d, d)), rng.normal(size=(60, 2, 2))
    mean, covariance = rng.normal(size=(60, d)), root @ root.transpose(0, 2, 1)
    slope, noise = rng.normal(size=(60, 2, d)), noise_root @ noise_root.transpose(0, 2, 1)
    shift = 3.0 * rng.normal(size=(60, 2))
    total, surprise = propagated(slope, covariance) + noise, shift - np.einsum("kvw,kw->kv", slope, mean)
    after = Gaussian(mean, covariance).conditional(covariance @ slope.transpose(0, 2, 1), surprise, total)
    out = np.empty((60, d)), np.empty((60, d, d)), np.empty(60), np.empty(60)
    getattr(update_in_plane, way)(mean, covariance, slope, noise, shift, *out)
    expected = after.mean, after.covariance, log_density(surprise, total), mahalanobis_sq(surprise, total)
    for ours, theirs in zip(out, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)
    assert np.array_equal(out[1], out[1].transpose(0, 2, 1))


@pytest.mark.parametrize("way", ["interpreted", "compiled"])
def test_evidence_is_averaged_over_motions_and_interpolated_between_correlations(way):
    rng = np.random.default_rng(6)
    shift, roots = 2.0 * rng.normal(size=(20, 2)), rng.normal(size=(2, 20, 2, 2))
    first, motion = (root @ root.transpose(0, 2, 1) + 0.2 * np.eye(2) for root in roots)
    log_p, shares = np.empty((20, len(CORRELATIONS))), np.array([1.0, 0.1])
    getattr(correlated_shifts, way)(shift, 2.0 * first, 2.0 * first, motion, CORRELATIONS, shares, 1e-6, log_p)
    for c, rho in enumerate(CORRELATIONS.tolist()):
        spread = 2.0 * (1.0 - rho) * first + 1e-6 * np.eye(2)
        due = np.logaddexp.reduce([log_density(shift, spread + share * motion) for share in shares])
        np.testing.assert_allclose(log_p[:, c], due, rtol=1e-9)
    source, rho, lasting = rng.integers(0, 3, 20), rng.random((20, 4)), np.array([0.0, 0.5, 0.9])
    evidence = np.ones((3, 3, 4))
    getattr(add_evidence, way)(source, rho, log_p, CORRELATIONS, lasting, evidence)
    for s, share in enumerate(lasting):
        for t in range(4):
            each = [np.interp(share + (1 - share) * r, CORRELATIONS, p) for r, p in zip(rho[:, t], log_p, strict=True)]
            np.testing.assert_allclose(evidence[:, s, t], 1.0 + np.bincount(source, each, 3), rtol=1e-9)


@pytest.mark.parametrize("way", ["interpreted", "compiled"])
def test_errors_of_kilometres_in_one_direction_give_finite_evidence(way):
    """Plots nearer to a radar than their assumed height: fully correlated, both errors cancel but for rounding."""
    rng = np.random.default_rng(4)

    def cholesky(angle, along_m):
        axis, across = (np.stack([np.cos(at), np.sin(at)], axis=-1) for at in (angle, angle + np.pi / 2.0))
        root = np.stack([along_m[:, None] * axis, 0.03 * across], axis=-1)
        return np.linalg.cholesky(root @ root.transpose(0, 2, 1))

    angle, along_m = rng.uniform(0.0, np.pi, 300), 10.0 ** rng.uniform(3.0, 5.0, 300)
    one, other = cholesky(angle, along_m), cholesky(angle + 1e-9, along_m)
    both = one @ one.transpose(0, 2, 1) + other @ other.transpose(0, 2, 1)
    shared = one @ other.transpose(0, 2, 1) + other @ one.transpose(0, 2, 1)
    log_p, shares = np.empty((300, len(CORRELATIONS))), np.array([0.0, 0.5, 1.0])
    shift, motion = rng.normal(size=(300, 2)), np.zeros((300, 2, 2))
    getattr(correlated_shifts, way)(shift, both, shared, motion, CORRELATIONS, shares, 1e-6, log_p)
    assert np.isfinite(log_p).all()


def known_share(share, names=("one", "two", "three")):
    """An estimate that is sure of one lasting share for all sources but the last, which has none."""
    at = DEFAULT_TUNING.lasting_shares.index(share)
    log_probable = np.full((len(names), len(DEFAULT_TUNING.lasting_shares), len(DEFAULT_TUNING.correlation_s)), -50.0)
    log_probable[:-1, at, 0] = log_probable[-1, 0, 0] = 0.0
    return log_probable


@pytest.mark.parametrize(("true", "lowest"), [(0.9, 0.6), (0.0, -0.1)])
def test_errors_of_measured_velocities_do_not_count_as_new_errors(true, lowest):
    # After a minute they are larger than the errors of positions, and the random walk that is assumed is not there.
    rng, n = np.random.default_rng(1), 400
    position, velocity, walk = (variance * np.ones((n, 1, 1)) * np.eye(2) for variance in (25.0**2, 900.0, 720.0))
    shift = rng.standard_normal((n, 2)) * np.sqrt(2.0 * (1.0 - true) * 25.0**2 + 900.0)
    prior = np.zeros((1, len(DEFAULT_TUNING.lasting_shares), len(DEFAULT_TUNING.correlation_s)))
    estimate = ErrorCorrelation(("one",), prior, prior).updated(
        np.zeros(n, np.int64), np.full(n, 60.0), shift, (2.0 * position, position), (velocity + walk, velocity)
    )
    (correlation,) = estimate.correlation(np.zeros(1, np.int64), np.array([60.0]))
    assert lowest < correlation < true + 0.1


def test_only_evidence_that_was_weighed_by_too_low_a_share_is_outgrown():
    estimate = ErrorCorrelation(("one", "two", "three"), known_share(0.1), known_share(0.1), used=np.full(3, np.nan))
    for share, outgrown in ((0.1, False), (0.25, False), (0.5, True), (0.25, False), (0.1, False), (0.9, True)):
        estimate, found = replace(estimate, log_probable=known_share(share)).weighing(DEFAULT_TUNING)
        assert found.tolist() == [outgrown, outgrown, False], share
        assert estimate.used[2] == pytest.approx(0.0, abs=1e-6)
    assert estimate.used[0] == pytest.approx(0.9)


@pytest.mark.parametrize(("sigma_m", "lost"), [(5.0, True), (1.0, False)])
def test_pairs_lose_the_evidence_that_was_outgrown_and_only_that(sigma_m, lost):
    """sigma_m : of the source whose share grew; that of the others is 5 m."""
    rng = np.random.default_rng(5)
    times = np.arange(4) * 10.0
    x, v = straight([[0.0, 0.0], [60.0, 0.0]], 4.0 * np.ones((2, 2)), times)
    names = ("one", "two", "three")
    errors = {"one": sigma_m, "two": 5.0, "three": 5.0}
    sources = [feed(rng, describe(name, "tracks", errors[name]), times, x, v, 0.0, ["a", "b"]) for name in names]
    watch = Watch()
    for time_s in times:
        watch = watch.advance(Scene.of(sources).at(time_s)).watch
    memory = watch.memory
    order = memory.tracks.error_correlation.names
    log_probable = known_share(0.97)
    log_probable[[order.index("one"), order.index("two"), order.index("three")]] = log_probable[[0, 2, 2]]
    used = np.zeros(3)
    correlation = replace(memory.tracks.error_correlation, log_probable=log_probable, used=used)
    after = replace(memory, tracks=replace(memory.tracks, error_correlation=correlation))
    after = after._with_present_correlation(DEFAULT_TUNING)
    source_of = dict(zip(memory.tracks.number.tolist(), memory.tracks.source.tolist(), strict=True))
    pairs = zip(memory.track_pairs.first.tolist(), memory.track_pairs.second.tolist(), strict=True)
    outgrown = np.array([order.index("one") in (source_of[a], source_of[b]) for a, b in pairs])
    assert outgrown.any() and not outgrown.all() and (memory.track_pairs.log_ratio[outgrown] != 0.0).all()
    for column in ("log_ratio", "log_convoy", "by_model"):
        new, old = getattr(after.track_pairs, column), getattr(memory.track_pairs, column)
        np.testing.assert_array_equal(new[outgrown], 0.0 if lost else old[outgrown])
        np.testing.assert_array_equal(new[~outgrown], old[~outgrown])
    assert after.tracks.error_correlation.used[order.index("one")] == pytest.approx(0.97)
