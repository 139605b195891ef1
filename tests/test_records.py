"""`Records.of` checks its input: bad rows are set aside with a reason, or refused with a clear message."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import naive
from sameas import InputError, Plane, Records, Sphere
from sameas.records import unpack

SQUARE = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
FULL = np.array([[4.0, 1.0], [1.0, 9.0]])


# ---- errors of every accepted shape ----


@pytest.mark.parametrize(
    "given, expected",
    [
        ({"sigma": 2.0}, [np.eye(2) * 4] * 3),
        ({"sigma": [1.0, 2.0, 3.0]}, [np.eye(2), np.eye(2) * 4, np.eye(2) * 9]),
        ({"sigma": [1.0, 2.0]}, [np.diag([1.0, 4.0])] * 3),
        ({"sigma": [[1.0, 2.0]] * 3}, [np.diag([1.0, 4.0])] * 3),
        ({"sigma": [[1.0], [2.0], [3.0]]}, [np.eye(2), np.eye(2) * 4, np.eye(2) * 9]),
        ({"variance": 2.0}, [np.eye(2) * 2] * 3),
        ({"variance": [1.0, 2.0]}, [np.diag([1.0, 2.0])] * 3),
        ({"covariance": FULL}, [FULL] * 3),
        ({"covariance": [FULL, 2 * FULL, 3 * FULL]}, [FULL, 2 * FULL, 3 * FULL]),
    ],
)
def test_errors_of_every_shape_give_the_same_covariances(given, expected):
    np.testing.assert_allclose(Records.of(SQUARE, **given).full_covariance(), expected)


def test_sigmas_for_as_many_records_as_features_are_one_per_record():
    records = Records.of(SQUARE[:2], sigma=[1.0, 2.0])
    np.testing.assert_allclose(records.full_covariance(), [np.eye(2), np.eye(2) * 4])


@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_packed_covariances_unpack_to_the_input(d):
    rng = np.random.default_rng(d)
    root = rng.standard_normal((5, d, d))
    full = root @ root.transpose(0, 2, 1) + np.eye(d)
    records = Records.of(np.zeros((5, d)), covariance=full)
    assert records.covariance.shape == (5, d * (d + 1) // 2)
    np.testing.assert_allclose(unpack(records.covariance, d), full)


def test_one_feature_may_be_one_dimensional():
    records = Records.of([1.0, 2.0, 3.0], sigma=0.1)
    assert records.features.shape == (3, 1) and records.d == 1 and len(records) == records.n_table == 3


def test_zero_records_are_allowed():
    for d in (1, 2, 3):
        records = Records.of(np.empty((0, d)), sigma=1.0, source="radar")
        assert len(records) == 0 and records.d == d and records.full_covariance().shape == (0, d, d)


# ---- rows set aside ----


def test_rows_without_position_or_error_are_set_aside_with_their_reason():
    features = np.array([[0.0, 0.0], [np.nan, 0.0], [1.0, np.inf], [2.0, 2.0], [3.0, 3.0]])
    sigma = np.array([1.0, 1.0, 1.0, np.nan, 2.0])
    records = Records.of(features, sigma=sigma, ids=list("abcde"))
    np.testing.assert_array_equal(records.rows, [0, 4])
    np.testing.assert_array_equal(records.features, features[[0, 4]])
    np.testing.assert_array_equal(records.covariance[:, 0], [1.0, 4.0])
    np.testing.assert_array_equal(records.set_aside.rows, [1, 2, 3])
    assert list(records.set_aside.reasons) == ["no position", "no position", "no error"]
    assert records.set_aside.counts() == {"no error": 1, "no position": 2}
    # ids are those of all rows of the table.
    assert records.n_table == 5 and list(records.ids) == list("abcde")


def test_masked_cells_are_missing_whatever_number_is_under_the_mask():
    features = np.ma.MaskedArray([[0.0, 0.0], [1.0, 1.0]], mask=[[False, True], [False, False]])
    sigma = np.ma.MaskedArray([1.0, -99.0], mask=[False, True])
    records = Records.of(features, sigma=sigma)
    assert len(records) == 0
    assert list(records.set_aside.reasons) == ["no position", "no error"]


def test_bad_errors_are_set_aside_on_request():
    records = Records.of(SQUARE, sigma=[1.0, -1.0, 0.0], invalid="set aside")
    assert len(records) == 1 and list(records.set_aside.reasons) == ["error not positive"] * 2
    bad = np.array([FULL, [[1.0, 1.0], [1.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]])
    assert len(Records.of(SQUARE, covariance=bad, invalid="set aside")) == 1
    polar = Records.of([[0.0, 90.0], [0.0, 90.1]], sigma=1.0, space=Sphere(), invalid="set aside")
    assert len(polar) == 1 and polar.set_aside.counts() == {"latitude beyond ±90°": 1}


@pytest.mark.parametrize("d", [2, 3])
def test_positive_definite_means_positive_eigenvalues(d):
    rng = np.random.default_rng(d)
    root = rng.standard_normal((400, d, d))
    matrices = root @ root.transpose(0, 2, 1) - rng.uniform(0, 1.5, (400, 1, 1)) * np.eye(d)
    scale = 10.0 ** rng.uniform(-6, 6, (400, d))
    matrices = matrices * scale[:, :, None] * scale[:, None, :]
    positive = np.array(
        [np.all(np.linalg.eigvalsh(m / np.outer(s, s)) > 0) for m, s in zip(matrices, scale, strict=True)]
    )
    records = Records.of(np.zeros((400, d)), covariance=matrices, invalid="set aside")
    assert 50 < positive.sum() < 350
    np.testing.assert_array_equal(records.rows, np.flatnonzero(positive))


def test_records_do_not_change_the_input_arrays():
    features, sigma = SQUARE.copy(), np.array([1.0, 2.0, 3.0])
    Records.of(features, sigma=sigma)
    np.testing.assert_array_equal(features, SQUARE)
    np.testing.assert_array_equal(sigma, [1.0, 2.0, 3.0])


def test_the_reference_implementation_reads_records():
    delta, cov = naive.residual(Records.of(SQUARE, covariance=FULL), 1, Records.of(SQUARE, sigma=2.0), 0)
    np.testing.assert_allclose(delta, [2.0, 2.0])
    np.testing.assert_allclose(cov, FULL + 4 * np.eye(2))


# ---- messages ----


def of(features=SQUARE, **keywords):
    return lambda: Records.of(features, source="radar", **keywords)


@pytest.mark.parametrize(
    "make, words",
    [
        (of(), "radar: give one of sigma, variance, covariance; got none"),
        (of(sigma=1.0, variance=1.0), "radar: give one of .* got sigma and variance"),
        (of(sigma=[1.0] * 4), r"radar: sigma has shape \(4,\); give one number, \(3,\), \(2,\) or \(3, 2\)"),
        (of(sigma=["a", "b", "c"]), "radar: sigma are not numbers"),
        (of([["x", "y"]], sigma=1.0), "radar: features are not numbers"),
        (of(np.zeros((2, 2, 2)), sigma=1.0), r"radar: features have shape \(2, 2, 2\); give \(rows, features\)"),
        (of(sigma=[1.0, 0.0, 2.0]), r"radar: 1 errors are zero or negative \(first: row 1, variance 0\)"),
        (of(sigma=[1.0, 2.0, -3.0]), r"first: row 2, variance -9\); give positive sigmas"),
        (of(variance=-1.0), "radar: 3 errors are zero or negative"),
        (of(covariance=np.eye(3)), r"radar: covariance has shape \(3, 3\); give \(2, 2\) or \(3, 2, 2\)"),
        (of(covariance=[FULL, FULL, -FULL]), r"radar: 1 covariances are not positive definite \(first: row 2\)"),
        (of(covariance=[[1.0, 1.0], [1.0, 1.0]]), "3 covariances are not positive definite .* check the correlations"),
        (of(covariance=[FULL, [[1.0, 0.5], [0.2, 1.0]], FULL]), r"1 covariances are not symmetric \(first: row 1\)"),
        (of(sigma=1e-80), "radar: errors of 1e-80 to 1e-80 in 2 features have no product that a number can hold; give"),
        (of(np.zeros((3, 100)), sigma=1e3), "errors of 1e\\+03 to 1e\\+03 in 100 features have no product"),
        (of(sigma=1.0, ids=[1, 2]), r"radar: \(2,\) ids for 3 rows; give one id per row"),
        (of(sigma=1.0, ids=[7, 8, 7]), r"1 id is not unique \(first: 7 in rows 0 and 2\)"),
        (of(sigma=1.0, ids=["b", "a", "a"]), r"1 id is not unique \(first: a in rows 1 and 2\)"),
        (of(sigma=1.0, invalid="drop"), 'radar: invalid=\'drop\'; give "refuse" or "set aside"'),
        (of([1.0, 2.0], sigma=1.0, space=Sphere()), "radar: a direction has 2 features .* got 1"),
        (of([[0.0, 91.0]], sigma=1.0, space=Sphere()), r"1 latitudes lie beyond ±90° \(row 0: 91\)"),
        (of(sigma=1.0, space=Plane((1.0,))), "Plane has 1 periods, but the records have 2 features"),
        (lambda: Plane((1.0, math.nan)), "period of axis 1 is nan; give a positive number or None"),
    ],
)
def test_invalid_records_are_refused_with_a_clear_message(make, words):
    with pytest.raises(InputError, match=words):
        make()


@given(
    values=arrays(float, (3, 2), elements=st.sampled_from([0.0, 45.0, 90.0, -91.0, np.nan, np.inf, -np.inf])),
    sigma=arrays(float, (3, 1), elements=st.sampled_from([0.1, 1.0, 0.0, -1.0, np.nan, np.inf])),
)
def test_rows_are_set_aside_together_as_each_alone(values, sigma):
    together = Records.of(values, sigma=sigma, space=Sphere(), invalid="set aside")
    alone = [
        len(Records.of(values[k : k + 1], sigma=sigma[k : k + 1], space=Sphere(), invalid="set aside")) == 1
        for k in range(3)
    ]
    assert together.rows.tolist() == np.flatnonzero(alone).tolist()
    known = np.isfinite(values).all(axis=1) & (np.abs(values[:, 1]) <= 90.0) & np.isfinite(sigma[:, 0])
    assert alone == (known & (sigma[:, 0] > 0.0)).tolist()
