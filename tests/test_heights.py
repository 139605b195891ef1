"""Heights and vertical speeds as evidence, against numerical integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from sameas import Radius, Records
from sameas.errors import InputError
from sameas.evidence import Heights


def pairs(n: int, m: int):
    return Radius(1.0)(
        Records.of(np.zeros((n, 2)), sigma=1.0, source="a"), Records.of(np.zeros((m, 2)), sigma=1.0, source="b")
    )


def test_the_ratio_of_two_heights_agrees_with_its_integral() -> None:
    """One object of a height anywhere in 13 km, against two: the rule's normal law is the integral within 1 %."""
    for h, k, s, t in ((5000.0, 5030.0, 20.0, 40.0), (3000.0, 3200.0, 60.0, 60.0)):
        found = Heights({"a": np.array([[h, s]]), "b": np.array([[k, t]])}, wrong=1e-9)(pairs(1, 1)).log_ratio[0]

        def weight(x: float, h: float = h, k: float = k, s: float = s, t: float = t) -> float:
            return float(norm.pdf(h, x, s) * norm.pdf(k, x, t))

        same = quad(weight, 0.0, 13_000.0, points=[h, k])[0] / 13_000.0
        assert found == pytest.approx(np.log(same * 13_000.0**2), abs=0.01)


def test_the_order_of_the_sources_does_not_matter_and_a_missing_height_is_neutral() -> None:
    rng = np.random.default_rng(3)
    one = np.column_stack([rng.uniform(0, 12e3, 9), rng.uniform(10, 90, 9)])
    two = np.column_stack([rng.uniform(0, 12e3, 7), rng.uniform(10, 90, 7)])
    one[2], two[5] = np.nan, np.nan
    rule = Heights({"a": one, "b": two})
    here = pairs(9, 7)
    there = Radius(1.0)(here.second, here.first)
    forward, back = rule(here).log_ratio, rule(there).log_ratio
    turned = {(j, i): v for i, j, v in zip(there.i.tolist(), there.j.tolist(), back.tolist(), strict=True)}
    for i, j, value in zip(here.i.tolist(), here.j.tolist(), forward.tolist(), strict=True):
        assert value == turned[i, j]
        assert (value == 0.0) == (i == 2 or j == 5)
    assert not Heights({"a": one})(here).informative.any()


def test_common_heights_have_less_weight_and_wrong_ones_are_bounded() -> None:
    alone = Heights({"a": np.array([[3000.0, 20.0]]), "b": np.array([[3000.0, 20.0]])})(pairs(1, 1)).log_ratio[0]
    level = np.full((50, 2), [3000.0, 20.0])
    shared = Heights({"a": level, "b": level})(pairs(50, 50)).log_ratio
    assert shared.max() < alone - 1.5
    far = Heights({"a": np.array([[3000.0, 20.0]]), "b": np.array([[9000.0, 20.0]])})(pairs(1, 1)).log_ratio[0]
    assert far == pytest.approx(np.log(0.01))


def test_the_ratio_of_two_vertical_speeds_agrees_with_its_integral_and_adds_to_that_of_heights() -> None:
    level = {"a": np.array([[3000.0, 20.0]]), "b": np.array([[3000.0, 20.0]])}
    for v, w, s, t in ((-9.0, -8.0, 1.5, 1.5), (6.0, 4.0, 0.5, 3.0)):
        speeds = {"a": np.array([[v, s]]), "b": np.array([[w, t]])}
        found = Heights(level, climbs=speeds, wrong_climb=1e-9)(pairs(1, 1)).terms

        def weight(x: float, v: float = v, w: float = w, s: float = s, t: float = t) -> float:
            return float(norm.pdf(v, x, s) * norm.pdf(w, x, t))

        same = quad(weight, -15.0, 15.0, points=[v, w])[0] / 30.0
        assert found["vertical speed"][0] == pytest.approx(np.log(same * 30.0**2), abs=0.02)
        assert found["height"][0] == Heights(level)(pairs(1, 1)).log_ratio[0]


def test_wrong_vertical_speeds_are_bounded_and_those_of_level_flight_are_weak_evidence() -> None:
    none = {"a": np.full((9, 2), np.nan), "b": np.full((9, 2), np.nan)}
    level, climbs = np.full((9, 2), [0.0, 1.5]), np.full((9, 2), [0.0, 1.5])
    climbs[0, 0] = 12.0
    here = pairs(9, 9)
    found = Heights(none, climbs={"a": climbs, "b": climbs})(here).log_ratio
    ratio = {(i, j): r for i, j, r in zip(here.i.tolist(), here.j.tolist(), found.tolist(), strict=True)}
    assert ratio[0, 0] > 1.0 and ratio[0, 0] > ratio[1, 1] + 0.8 and 0.0 < ratio[1, 1] < 1.0
    assert ratio[0, 1] == pytest.approx(np.log(0.05), abs=0.01)
    assert not Heights(none, climbs={"a": level})(pairs(9, 9)).log_ratio.any()


def test_a_fill_value_among_the_heights_changes_no_other_ratio() -> None:
    one = Records.of([[0.0, 0.0]], sigma=50.0, source="radar")
    two = Records.of([[10.0, 0.0], [0.0, 10.0]], sigma=50.0, source="adsb")
    pairs = Radius(9.0)(one, two)
    radar = np.array([[10_000.0, 20.0]])
    near, far = (
        Heights({"radar": radar, "adsb": np.array([[10_010.0, 20.0], [other, 20.0]])})(pairs).log_ratio
        for other in (1e6, 9.96921e36)
    )
    np.testing.assert_allclose(far, near)


def test_invalid_heights_are_refused_with_a_clear_message() -> None:
    with pytest.raises(InputError, match=r"a: row 1: the height's error is 0.0; give metres above 0"):
        Heights({"a": np.array([[1.0, 1.0], [2.0, 0.0]])})
    with pytest.raises(InputError, match=r"a: heights have the shape \(3,\)"):
        Heights({"a": np.zeros(3)})
    with pytest.raises(InputError, match=r"a: row 0: the vertical speed's error is -1.0; give m/s above 0"):
        Heights({}, climbs={"a": np.array([[1.0, -1.0]])})
    with pytest.raises(InputError, match="a: 1 heights for 2 rows"):
        Heights({"a": np.ones((1, 2)), "b": np.ones((1, 2))})(pairs(2, 1))
