"""The mixture of stationary and moving vessels, against its definition and simulated vessels."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sameas.errors import InputError
from sameas.tracks.alignment import States, moved
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.feed import Feed, stationary
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Motion

VESSELS = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.3)


def reported_states(velocity, sigma_m_per_s=0.3, sigma_m=5.0):
    n = len(velocity)
    return States.of(
        np.zeros(n), np.zeros((n, 2)), sigma_m**2 * np.eye(2), speed_m_per_s=8.0, velocity=velocity,
        velocity_covariance=sigma_m_per_s**2 * np.eye(2),
    )  # fmt: skip


def test_the_probability_of_being_stationary_follows_bayes():
    rng = np.random.default_rng(1)
    velocity = rng.normal(0.0, 0.8, (30, 2))
    _, stands = stationary(reported_states(velocity), VESSELS)
    near, far = (multivariate_normal.pdf(velocity, cov=(0.09 + s**2) * np.eye(2)) for s in (0.1, 8.0))
    np.testing.assert_allclose(stands, 0.3 * near / (0.3 * near + 0.7 * far), rtol=1e-9)


def test_mean_and_covariance_agree_with_the_mixture():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4)) * np.array([5.0, 5.0, 0.4, 0.4])[:, None]
    state, covariance = np.array([[3.0, -7.0, 1.3, 0.5]]), (root @ root.T)[None]
    made = States(np.zeros(1), state, covariance, None, np.arange(1))
    now, stands = stationary(made, VESSELS)
    assert 0.05 < stands[0] < 0.95
    gain = covariance[0][:, 2:] @ np.linalg.inv(covariance[0][2:, 2:] + 0.01 * np.eye(2))
    lies = state[0] - gain @ state[0, 2:], covariance[0] - gain @ covariance[0][2:]
    many = np.vstack([rng.multivariate_normal(mean, spread, int(400_000 * share)) for share, (mean, spread)
                      in ((stands[0], lies), (1.0 - stands[0], (state[0], covariance[0])))])  # fmt: skip
    np.testing.assert_allclose(now.state[0], many.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(now.covariance[0], np.cov(many.T), rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_states_of_simulated_vessels_are_consistent():
    rng = np.random.default_rng(6)
    n, age_s = 100_000, 180.0
    lies = rng.random(n) < 0.3
    velocity = np.where(lies[:, None], 0.1, 8.0) * rng.standard_normal((n, 2))
    there, _ = moved(np.column_stack([np.zeros((n, 2)), velocity]), np.zeros((n, 4, 4)), age_s, 0.0)
    walk = np.where(lies, 0.0, 0.01)
    there[:, :2] += np.sqrt(walk * age_s**3 / 3.0)[:, None] * rng.standard_normal((n, 2))
    made = reported_states(velocity + 0.3 * rng.standard_normal((n, 2)))
    now, stands = stationary(made, VESSELS)
    error, spread = _off(now, there, age_s, 0.01 * (1.0 - stands))
    before, wide = _off(made, there, age_s, 0.01)
    slow = stands > 0.5
    for some in (slow, ~slow):
        square = np.einsum("nv,nvw,nw->n", error[some], np.linalg.inv(spread[some]), error[some])
        assert square.mean() == pytest.approx(2.0, rel=0.1)
    assert np.sqrt(np.mean(error[slow] ** 2)) < 0.6 * np.sqrt(np.mean(before[slow] ** 2))
    assert np.sqrt(np.linalg.det(spread[slow])).mean() < 0.1 * np.sqrt(np.linalg.det(wide[slow])).mean()


def _off(states, there, age_s, walk):
    ahead, spread = moved(states.state, states.covariance, age_s, walk)
    # The reported position does not matter here.
    return ahead[:, :2] - there[:, :2], spread[:, :2, :2] - states.covariance[:, :2, :2] + 1e-6 * np.eye(2)


def test_missing_velocities_and_always_moving_kinds_are_unchanged():
    bare = States.of(np.zeros(2), np.zeros((2, 2)), np.eye(2), speed_m_per_s=8.0)
    now, stands = stationary(bare, VESSELS)
    np.testing.assert_array_equal(now.covariance, bare.covariance)
    np.testing.assert_array_equal(stands, [0.0, 0.0])
    made = reported_states(np.zeros((2, 2)))
    assert stationary(made, Description("adsb", "ads-b").motion) == (made, None)
    assert stationary(made, Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.0)) == (made, None)
    with pytest.raises(InputError, match="give the share of stationary objects, below 1"):
        stationary(made, Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=1.0))


def test_an_anchored_vessel_is_not_extrapolated_and_a_moving_one_is():
    columns = {"time_s": [0.0, 0.0], "lat_deg": [50.8, 50.9], "lon_deg": [-1.3, -1.3],
               "speed_m_per_s": [0.05, 6.0], "course_deg": [200.0, 90.0]}  # fmt: skip
    reports = Reports.of("ais", "table", columns | {"mmsi": ["235000001", "235000002"]})
    feed = Feed.of(Description("ais", "ais"), reports, LocalPlane(50.85, -1.3))
    assert isinstance(feed.reports, States)
    ahead, spread = moved(feed.reports.state, feed.reports.covariance, 180.0, feed.walk_m2_per_s3)
    sigma = np.sqrt(spread[:, 0, 0])
    assert sigma[0] < 35.0
    assert sigma[1] > 130.0
    assert np.hypot(*(ahead[0, :2] - feed.reports.state[0, :2])) < 2.0
    assert ahead[1, 0] - feed.reports.state[1, 0] == pytest.approx(1080.0, rel=0.01)
