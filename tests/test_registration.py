"""The offset between two sources is found at any size, with true standard errors, or reported as undetermined."""

from dataclasses import replace

import numpy as np
import pytest

import naive
from sameas import Errors, InputError, Plane, Records, Sphere
from sameas.estimate.match import match
from sameas.evidence import Field
from sameas.kernels import offsets
from sameas.prior import CommonObjects
from sameas.registration import Affine, SensorBias, Shift, Similarity, register
from sameas.registration.hough import HoughSearch
from sameas.registration.offsets import Offset
from sameas.registration.solution import OffsetPrior, Trials, missing_information, normal_equations
from sameas.registration.weights import PlacedSources, weigh
from sameas.score.pairs import score_pairs
from sameas.simulate.scenes import Cap, grid, poisson_field, sky_field
from sameas.space import displaced


def field(seed, *, q=0.2, density=0.02, n=40):
    """About n objects at ``density`` per σ², σ = 1 the total error of one feature."""
    side = (n / density) ** 0.5
    return poisson_field(
        np.random.default_rng(seed), density=density, extent=(side, side), q1=q, q2=q, sigma_1=0.6, sigma_2=0.8
    )


def put(records, features):
    return replace(records, features=np.ascontiguousarray(features))


def f1(made, answer):
    found = answer.matches
    return score_pairs((found.rows_1, found.rows_2), made.true_pairs()).f1


def inverse_positions(model, theta, wanted):
    """The positions that the offset moves to ``wanted``, by Newton's method."""
    at = wanted.copy()
    for _ in range(20):
        missing = wanted - model.moved(at, theta)
        at = at + np.linalg.solve(model.carried(at, theta), missing[..., None])[..., 0]
    return at


VELOCITY = np.random.default_rng(8).normal(0.0, 2.0, (200, 2))


def sensor(records, **widths):
    return SensorBias((-15.0, -10.0), velocity=VELOCITY[: len(records)], **widths)


# ---- the models ----


@pytest.mark.parametrize(
    "model, theta",
    [
        (Shift(), [3.0, -7.0]),
        (Similarity(), [3.0, -7.0, 4.0, 0.02]),
        (Affine(), [3.0, -7.0, 0.01, 0.03, -0.02, 0.05]),
        (SensorBias((-15.0, -10.0), gain_width=0.02), [2.0, 3.0, 0.02]),
        (SensorBias((-15.0, -10.0), gain_width=0.02, time_width=1.0, velocity=VELOCITY[:9]), [2.0, 3.0, 0.02, 1.5]),
        (SensorBias((-15.0, -10.0), range_width=0.0), [3.0]),
    ],
)
def test_derivatives_of_an_offset_are_those_of_its_positions(model, theta):
    records = Records.of(np.random.default_rng(0).uniform(0, 40, (9, 2)), sigma=0.5)
    model, theta, x = model.placed(records, records), np.array(theta), records.features
    assert len(model.names) == len(model.units) == len(model.widths) == len(theta)
    by_theta = [(model.moved(x, theta + e) - model.moved(x, theta - e)) / 2e-5 for e in 1e-5 * np.eye(len(theta))]
    np.testing.assert_allclose(model.jacobian(x, theta), np.stack(by_theta, axis=-1), atol=1e-7)
    by_place = [(model.moved(x + e, theta) - model.moved(x - e, theta)) / 2e-5 for e in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(model.carried(x, theta), np.stack(by_place, axis=-1), atol=1e-7)
    many = model.moved(x, np.stack([theta, 0.5 * theta])[:, None, :])
    np.testing.assert_allclose(many[1], model.moved(x, 0.5 * theta))
    np.testing.assert_allclose(model.moved(x, 0.0 * theta), x, atol=1e-12)


def test_range_bearing_and_time_biases_of_a_sensor_are_corrected():
    seen = np.array([[0.0, 10.0]])
    records = Records.of(seen, sigma=0.1)
    moved = lambda model, theta: model.placed(records, records).moved(seen, np.array(theta))  # noqa: E731
    np.testing.assert_allclose(moved(SensorBias((0, 0), azimuth_width_deg=0), [2.0]), [[0.0, 8.0]], atol=1e-12)
    # A bearing read 90° too far clockwise: the object is in the west.
    np.testing.assert_allclose(moved(SensorBias((0, 0), range_width=0), [90.0]), [[-10.0, 0.0]], atol=1e-12)
    late = SensorBias((0, 0), 0.0, 0.0, time_width=1.0, velocity=[[3.0, 0.0]])
    np.testing.assert_allclose(moved(late, [2.0]), [[6.0, 10.0]], atol=1e-12)


# ---- the likelihood ----


def test_on_a_tree_weights_and_likelihood_are_sums_over_all_hypotheses():
    # On a chain of pairs belief propagation is exact.
    edges = {(0, 0): 0.7, (1, 0): 1.9, (1, 1): -0.4, (2, 1): 2.2, (2, 2): 0.1}
    i, j = np.array(list(edges)).T
    log_weight = np.array(list(edges.values()))
    share, log_sum, common = offsets.messages(np.array([0, 5]), i, j, log_weight, (3, 3), 100, 1e-12)
    total, of_pair = 0.0, dict.fromkeys(edges, 0.0)
    for hypothesis in naive.hypotheses(3, 3, set(edges)):
        weight = np.exp(sum(edges[pair] for pair in hypothesis))
        total += weight
        for pair in hypothesis:
            of_pair[pair] += weight
    assert log_sum[0] == pytest.approx(np.log(total), rel=1e-9)
    np.testing.assert_allclose(share, [of_pair[pair] / total for pair in edges], rtol=1e-7)
    assert common[0] == pytest.approx(share.sum())


def test_the_score_is_the_slope_of_the_likelihood_and_the_covariance_its_curvature():
    made = field(3, density=0.04)
    inner = np.abs(made.second.features - 15.0).max(axis=1) < 11.0
    # The second field lies within the first, so that the common field does not change with the offset.
    second = Records.of(made.second.features[inner], sigma=0.8)
    model = Shift().placed(made.first, second)
    scene = PlacedSources.of(made.first, second, model)
    belief = replace(OffsetPrior.of(scene), precision=np.zeros(2))
    theta, common = np.array([[0.2, -0.1]]), np.array([12.0])

    def slope(at):
        return normal_equations(scene, belief, at, weigh(scene, at, common, 1.0))[0][0]

    gain = lambda at: weigh(scene, at, common, 1.0).gain[0]  # noqa: E731
    numeric = [(gain(theta + e) - gain(theta - e)) / 2e-3 for e in 1e-3 * np.eye(2)]
    np.testing.assert_allclose(slope(theta), numeric, rtol=2e-3, atol=2e-3)
    complete = normal_equations(scene, belief, theta, weigh(scene, theta, common, 1.0))[1][0]
    axes, score, _ = missing_information(scene, belief, Trials(theta, common, np.zeros(1)), complete)
    np.testing.assert_allclose(score[0], slope(theta), rtol=1e-9)
    root = np.linalg.cholesky(np.linalg.inv(complete)) @ axes
    # Uncertain pairs reduce the information.
    assert np.all(np.linalg.eigvalsh(root @ root.T - np.linalg.inv(complete)) > 0)


# ---- large offsets ----


@pytest.mark.parametrize("shift", [0.0, 2.0, 8.0, 30.0, 400.0])
def test_shifts_of_any_size_lose_no_matches(shift):
    lost = []
    for seed in range(3):
        made = field(seed)
        away = shift * np.array([0.6, -0.8])
        found = register(made.first, put(made.second, made.second.features - away), Shift())
        error = found.theta - away
        assert error @ np.linalg.solve(found.covariance, error) < 16.0
        assert found.established and found.converged and found.notes == ()
        lost.append(f1(made, match(made.first, made.second, errors=Errors())[0]) - f1(made, found.identification))
    assert np.mean(lost) < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    "make, theta",
    [
        (lambda r: Similarity(), [9.0, -4.0, 2.0, 0.01]),
        (lambda r: Affine(), [9.0, -4.0, 0.02, -0.04, 0.03, -0.01]),
        (lambda r: sensor(r), [5.0, 4.0]),
        (lambda r: sensor(r, range_width=0.0), [-4.0]),
        (lambda r: sensor(r, gain_width=0.02, time_width=3.0), [5.0, 4.0, 0.02, -2.0]),
    ],
    ids=["similarity", "affine", "sensor", "azimuth", "sensor with gain and time"],
)
def test_other_offsets_are_found_within_their_errors(make, theta):
    for seed in range(2):
        made = field(seed, density=0.015, q=0.15)
        model: Offset = make(made.second).placed(made.first, made.second)
        theta = np.array(theta)
        found = register(made.first, put(made.second, inverse_positions(model, theta, made.second.features)), model)
        # The model defines the centre of rotation: the applied offset must be recovered.
        assert np.all(np.abs(found.theta - theta) < 4.0 * found.standard_errors), found.parameters
        assert found.established
        unshifted = f1(made, match(made.first, made.second, errors=Errors())[0])
        assert f1(made, found.identification) > unshifted - 0.1


@pytest.mark.slow
def test_standard_errors_agree_with_the_scatter():
    z = []
    for seed in range(45):
        made = field(seed, q=0.3, density=0.02)
        found = register(made.first, put(made.second, made.second.features - [4.0, 2.0]), Shift())
        z.append((found.theta - [4.0, 2.0]) / found.standard_errors)
    inside = np.mean(np.abs(z) < 1.96)
    # 90 values: a standard error of 0.023.
    assert 0.90 <= inside <= 0.99
    assert np.abs(np.mean(z)) < 0.25


def test_the_uncertainty_of_the_offset_is_in_the_covariance_of_every_pair():
    made = field(1)
    found = register(made.first, made.second, Shift())
    np.testing.assert_allclose(found.registered.full_covariance(), made.second.full_covariance() + found.covariance)
    np.testing.assert_allclose(found.registered.features, made.second.features + found.theta)
    assert found.identification.second is found.registered
    assert found.parameters["shift_x"].standard_error == pytest.approx(np.sqrt(found.covariance[0, 0]))


def test_swapping_the_sources_reverses_a_shift():
    made = field(2)
    second = put(made.second, made.second.features + np.array([12.0, 5.0]))
    one, two = register(made.first, second, Shift()), register(second, made.first, Shift())
    np.testing.assert_allclose(one.theta, -two.theta, atol=2e-3)
    np.testing.assert_allclose(one.covariance, two.covariance, rtol=0.01)
    assert one.log_evidence == pytest.approx(two.log_evidence, abs=0.05)


def test_a_small_overlap_with_a_clear_pattern_is_enough():
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 100, (150, 2))
    sides = [x[x[:, 0] < 58], x[x[:, 0] > 42]]
    first, second = (Records.of(part + 0.7 * rng.standard_normal(part.shape), sigma=0.7) for part in sides)
    found = register(first, put(second, second.features + np.array([33.0, -9.0])), Shift())
    np.testing.assert_allclose(found.theta, [-33.0, 9.0], atol=1.0)
    assert found.established


@pytest.mark.parametrize("d", [1, 3])
def test_a_shift_is_found_in_any_number_of_features(d):
    rng = np.random.default_rng(6)
    x = rng.uniform(0, 40 if d == 3 else 400, (50, d))
    first, second = (Records.of(x + 0.7 * rng.standard_normal(x.shape), sigma=0.7) for _ in range(2))
    away = 25.0 * np.arange(1, d + 1)
    found = register(first, put(second, second.features - away), Shift())
    np.testing.assert_allclose(found.theta, away, atol=0.7)
    assert found.model.names == (("shift_x",) if d == 1 else ("shift_x", "shift_y", "shift_z"))


def test_shifts_on_a_periodic_axis_wrap():
    rng = np.random.default_rng(7)
    x = np.stack([rng.uniform(0, 360, 40), rng.uniform(0, 100, 40)], axis=1)
    space = Plane((360.0, None))
    first, second = (Records.of(x + 0.7 * rng.standard_normal(x.shape), sigma=0.7, space=space) for _ in range(2))
    found = register(first, put(second, second.features + np.array([200.0, 5.0])), Shift())
    np.testing.assert_allclose([found.theta[0] % 360, found.theta[1]], [160.0, -5.0], atol=0.7)


@pytest.mark.parametrize("lat_deg", [0.0, -70.0])
def test_a_small_field_on_the_sphere_is_shifted_east_and_north(lat_deg):
    made = sky_field(
        np.random.default_rng(9), n_common=120, n_only_1=30, n_only_2=30, sigma_arcsec=0.3, area=Cap(0.02, lat_deg, 0.2)
    )
    away = np.broadcast_to([20.0, -7.0], made.second.features.shape)
    found = register(made.first, put(made.second, displaced(made.second.features, -away)), Shift())
    assert found.model.names == ("shift_east", "shift_north") and found.model.units == ("arcsec", "arcsec")
    np.testing.assert_allclose(found.theta, [20.0, -7.0], atol=0.25)
    assert f1(made, found.identification) > 0.95


@pytest.mark.slow
def test_many_records_are_registered_by_images_and_by_patches():
    made = field(10, n=700, density=0.01, q=0.1)
    model = Similarity().placed(made.first, made.second)
    theta = np.array([80.0, -33.0, 2.0, -0.01])
    found = register(made.first, put(made.second, inverse_positions(model, theta, made.second.features)), model)
    assert np.all(np.abs(found.theta - theta) < 4.0 * found.standard_errors)
    shifted = register(made.first, put(made.second, made.second.features - [80.0, -33.0]), Shift())
    np.testing.assert_allclose(shifted.theta, [80.0, -33.0], atol=0.15)


def test_offsets_with_errors_far_smaller_than_the_field_are_refined_in_steps():
    x = np.random.default_rng(3).uniform(0, 60, (40, 2))
    first, second = Records.of(x, sigma=1e-6), Records.of(x + np.array([30.0, 1.0]), sigma=1e-6)
    votes = HoughSearch(first, second, Shift().placed(first, second)).vote(8)
    np.testing.assert_allclose(votes.theta[0], [-30.0, -1.0], atol=1e-5)
    assert register(first, second, Shift()).common == pytest.approx(40.0, abs=0.01)


def test_a_custom_rule_and_prior_are_used():
    made = field(11)
    answer = register(made.first, made.second, Shift(), rule=Field(1 / 2000.0), prior=CommonObjects(0.2, 0.2))
    assert "elsewhere" in answer.identification.evidence.terms
    assert f1(made, answer.identification) > 0.7


# ---- undetermined offsets ----


def test_unrelated_sources_are_reported():
    rng = np.random.default_rng(12)
    wrongly_sure = 0
    for _ in range(5):
        first, second = (Records.of(rng.uniform(0, 60, (40, 2)), sigma=0.7, source=name) for name in ("radar", "ais"))
        found = register(first, second, Shift())
        wrongly_sure += found.established
        assert found.established or "radar and ais may have no object in common" in found.notes[0]
    assert wrongly_sure <= 1


@pytest.mark.slow
@pytest.mark.parametrize("q", [0.05, 0.3])
def test_ambiguous_offsets_of_a_lattice_are_reported(q):
    for seed in range(3):
        made = grid(np.random.default_rng(seed), shape=(6, 6), spacing_sigmas=6.0, q1=q, q2=q)
        found = register(made.first, made.second, Shift())
        assert not found.established and len(found.rivals) >= 1
        assert any("explain" in note and "log evidence lower by" in note for note in found.notes)


@pytest.mark.parametrize(
    "one, two, sigma",
    [([[0.0, 0.0]], [[5.0, 5.0]], 1.0), (np.zeros((10, 2)), np.zeros((10, 2)), 1.0), ([[0.0, 0.0]], None, 1.0)],
    ids=["one record each", "all in one place", "one against many"],
)
def test_too_few_pairs_are_reported(one, two, sigma):
    two = np.random.default_rng(0).uniform(0, 50, (30, 2)) if two is None else two
    found = register(Records.of(one, sigma=sigma), Records.of(two, sigma=sigma), Shift())
    assert not found.established and np.isfinite(found.theta).all() and np.isfinite(found.covariance).all()
    assert any("too few pairs" in note for note in found.notes) and found.iterations < 60


def test_errors_larger_than_the_field_are_reported():
    x = np.random.default_rng(1).uniform(0, 60, (40, 2))
    found = register(Records.of(x, sigma=100.0), Records.of(x, sigma=100.0), Shift())
    assert not found.established and np.isfinite(found.theta).all()


# ---- refusals ----


def refusals():
    flat = Records.of(np.ones((3, 2)) * np.arange(3)[:, None], sigma=1.0, source="radar")
    line = Records.of([0.0, 1.0], sigma=1.0, source="line")
    sky = Records.of([[1.0, 2.0], [3.0, 4.0]], sigma=1.0, space=Sphere(), source="sky")
    wide = Records.of([[1.0, 2.0], [90.0, 4.0]], sigma=1.0, space=Sphere(), source="wide")
    ring = Records.of([[1.0, 2.0]], sigma=1.0, space=Plane((360.0, None)), source="ring")
    none = Records.of(np.empty((0, 2)), sigma=1.0, source="none")
    return [
        (lambda: register(flat, line, Shift()), "radar has 2 features .* line 1"),
        (lambda: register(flat, none, Shift()), "none has no usable records"),
        (lambda: register(sky, sky, Similarity()), "Similarity: sky is on a sphere; project"),
        (lambda: register(wide, wide, Shift()), "Shift: wide reaches 44.* register field by field"),
        (lambda: register(ring, ring, Affine()), "a feature of ring is periodic"),
        (lambda: register(line, line, Similarity()), "line has 1 features; Similarity is for 2"),
        (lambda: register(flat, flat, SensorBias((0, 0), time_width=1.0, velocity=[[1.0, 1.0]])), r"give \(3, 2\)"),
        (lambda: SensorBias((0, 0), time_width=1.0), "a time offset needs velocity"),
        (lambda: SensorBias((0, 0), gain_width=np.inf), "gain_width is infinite"),
        (lambda: SensorBias((0, 0), 0.0, 0.0), "all widths are 0"),
        (lambda: SensorBias((0, 0, 0)), r"give \(east, north\) of the sensor"),
        (lambda: Shift(width=0.0), "width is 0"),
        (lambda: Similarity(rotation_deg=-1.0), "rotation_deg is -1.0"),
        (lambda: Offset().placed(flat, flat), "is the interface of offsets"),
    ]


@pytest.mark.parametrize("number", range(14))
def test_invalid_input_is_refused_with_the_remedy(number):
    call, words = refusals()[number]
    with pytest.raises((InputError, TypeError), match=words):
        call()
