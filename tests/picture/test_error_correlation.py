"""The correlation time of errors is learned from a source's own tracks, for any assumed process noise."""

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight

from sameas.gaussian import Gaussian, log_density, mahalanobis_sq, propagated
from sameas.kernels.kalman import add_evidence, correlated_shifts, update_in_plane
from sameas.picture import TrackMemory, Watch
from sameas.picture.error_factors import CORRELATIONS
from sameas.picture.tables import Scan
from sameas.tracks.scene import Scene


def learned(tau_s, kind="tracks", seed=1, looks=25, every_s=10.0, given=None):
    """The correlation of errors at the looks' interval, as learned of 40 tracks whose errors last for tau_s."""
    rng = np.random.default_rng(seed)
    times = np.arange(looks) * every_s
    x, v = straight(rng.uniform(-9e3, 9e3, (40, 2)), 4.0 * rng.standard_normal((40, 2)), times)
    scene = Scene.of([feed(rng, describe("one", kind), times, x, v, tau_s, [str(k) for k in range(40)])])
    memory = TrackMemory(correlation_s=given or {})
    for time_s in times:
        memory = memory.advance(Scan.of(scene.at(time_s)))
    return float(memory.tracks.error_correlation.correlation(np.zeros(1, np.int64), np.array([every_s]))[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tracks", "ais"])
@pytest.mark.parametrize("tau_s", [0.0, 12.0, 180.0])
def test_the_correlation_is_learned_for_any_assumed_kind(kind, tau_s):
    true = np.exp(-10.0 / tau_s) if tau_s else 0.0
    assert abs(learned(tau_s, kind) - true) < 0.12


@pytest.mark.slow
def test_a_given_correlation_is_not_estimated():
    assert learned(180.0, given={"one": 0.0}) == 0.0
    assert learned(0.0, given={"one": 30.0}) == pytest.approx(np.exp(-1.0 / 3.0))


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
