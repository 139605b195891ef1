"""The gate finds the pairs of a brute-force search, with the same residuals, in an order independent of the rows."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2

import naive
from problems import KINDS, by_id, crowd, plane_records, shuffled, sky_records
from sameas import Box, ChiSquare, InputError, Radius, Records, Sphere
from sameas.gate import Tuning
from sameas.gate.gate import quantile, upper_quantile
from sameas.kernels import threads
from sameas.kernels.compiled import Kernel
from sameas.space import Plane, sphere_offset

GATES = {
    "box": (Box(3.0), {"sigmas": 3.0}),
    "chi square": (ChiSquare(0.99), {"completeness": 0.99}),
    "radius": (Radius(2.5), None),
    "wide": (ChiSquare(), {"completeness": 1 - 1e-9}),
}


def test_more_pairs_than_fit_in_memory_are_refused_before_they_are_stored():
    gate = ChiSquare(tuning=Tuning(brute_force_records=0, bytes_of_pair=1 << 50))
    with pytest.raises(InputError, match=r"a, b: more than 0\.0 million pairs lie within the gate.*smaller gate"):
        gate(crowd(60), crowd(70, "b", 2))
    # Records with far larger errors are searched by a separate path.
    wide = Records.of([[0.0, 0.0]], sigma=100.0, source="b")
    with pytest.raises(InputError, match="the memory holds no more"):
        gate(crowd(300), wide)


def zone_search(first, second, gate):
    """The candidates found by the zone search, which small inputs would not use."""
    return replace(gate, tuning=Tuning(brute_force_records=0, max_pairs_by_arrays=0))(first, second)


def brute_force(first, second, gate, definition):
    if definition is not None:
        return naive.candidates(first, second, **definition)
    found = set()
    for i in range(len(first)):
        for j in range(len(second)):
            if naive.mahalanobis(*naive.residual(first, i, second, j)) <= gate.sigmas**2:
                found.add((i, j))
    return found


def assert_candidates(first, second, gate=GATES["box"][0], definition=GATES["box"][1], least=1):
    """The candidates are those of the definition, each once, and carry its residual, Σ, Δᵀ Σ⁻¹ Δ and |Σ|."""
    expected = brute_force(first, second, gate, definition)
    assert len(expected) >= least
    for pairs in (zone_search(first, second, gate), gate(first, second)):
        _assert_pairs(pairs, expected)
    return pairs


def _assert_pairs(pairs, expected):
    first, second = pairs.first, pairs.second
    found = list(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == expected
    for e, (i, j) in enumerate(found[:300]):
        delta, cov = naive.residual(first, i, second, j)
        size = math.sqrt(np.trace(cov))
        np.testing.assert_allclose(pairs.residual[e], delta, rtol=1e-9, atol=1e-9 * size)
        np.testing.assert_allclose(pairs.covariance[e], cov, rtol=1e-9, atol=1e-12 * size**2)
        assert pairs.determinant[e] == pytest.approx(np.linalg.det(cov), rel=1e-9)
        assert pairs.mahalanobis_sq[e] == pytest.approx(naive.mahalanobis(delta, cov), rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("sigma", ["circles", "ellipses"])
@pytest.mark.parametrize("lon, lat", [(10.0, -30.0), (0.0, 5.0), (200.0, 88.0)])
def test_the_array_search_of_few_records_equals_the_kernel_on_the_sky(monkeypatch, sigma, lon, lat):
    rng = np.random.default_rng(8)

    def records(source):
        at = np.column_stack([rng.normal(lon, 0.01 / math.cos(math.radians(lat)), 300), rng.normal(lat, 0.01, 300)])
        error = np.exp(rng.normal(0.0, 0.3, 300))
        if sigma == "ellipses":
            turn, size = rng.uniform(0, math.pi, 300), np.column_stack([error, 2.0 * error])
            axes = np.stack([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)], axis=1).reshape(-1, 2, 2)
            covariance = np.einsum("nij,nj,nkj->nik", axes, size**2, axes)
            return Records.of(at, covariance=covariance, space=Sphere(), source=source)
        return Records.of(at, sigma=error, space=Sphere(), source=source)

    first, second = records("a"), records("b")
    monkeypatch.setattr(Kernel, "interprets", property(lambda self: True))
    for gate in (ChiSquare(), Radius(2.0), Box(3.0)):
        by_arrays, by_kernel = gate(first, second), zone_search(first, second, gate)
        assert 100 < len(by_kernel) < 20_000
        for name in ("place_1", "place_2", "i", "j", "residual", "mahalanobis_sq", "determinant"):
            column, expected = getattr(by_arrays, name), getattr(by_kernel, name)
            assert column.dtype == expected.dtype and np.array_equal(column, expected), name


# ---- in a plane ----


@pytest.mark.slow
@pytest.mark.parametrize("name", GATES)
@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_candidates_in_a_plane_are_those_of_the_definition(d, name):
    gate, definition = GATES[name]
    for seed, kinds in enumerate([(a, b) for a in KINDS for b in KINDS]):
        rng = np.random.default_rng([d, seed])
        scale = 0.02 * 3.0 ** (d - 1)
        first = plane_records(rng, 25, d, scale=scale / 3, kind=kinds[0])
        second = plane_records(rng, 35, d, scale=scale / 3, kind=kinds[1])
        assert_candidates(first, second, gate, definition)


PERIODS: dict[str, list[tuple[float | None, ...]]] = {
    "swept or zone axis": [(1.0, None), (None, 1.0)],
    "all axes": [(1.0, 1.0), (0.7, 1.3)],
    "one feature": [(1.0,)],
    "three features": [(None, 1.0, 1.0), (1.0, 1.0, 1.0)],
}


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("periods", [p for several in PERIODS.values() for p in several])
@pytest.mark.parametrize("scale", [0.01, 0.08, 0.4])
def test_periodic_axes_wrap_for_gates_of_any_width(periods, scale):
    d = len(periods)
    for seed in range(3):
        rng = np.random.default_rng([seed, d, int(scale * 100)])
        # An elongated box makes now the one, now the other feature the swept axis.
        extent = rng.permutation([1.0, 0.5, 0.2][:d])
        first = plane_records(rng, 30, d, extent=extent, scale=scale, kind=KINDS[seed], periods=periods)
        second = plane_records(rng, 30, d, extent=extent, scale=scale / 3, kind=KINDS[2 - seed], periods=periods)
        assert_candidates(first, second)


def test_positions_a_thousand_periods_apart_are_the_same():
    periods = (360.0, None)
    first = Records.of([[5.0 + 360.0 * 1000, 0.0], [355.0, 0.0]], sigma=5.0, space=Plane(periods))
    second = Records.of([[-3.0 - 360.0 * 1000, 0.0]], sigma=5.0, space=Plane(periods))
    pairs = assert_candidates(first, second, least=2)
    np.testing.assert_allclose(np.sort(pairs.residual[:, 0]), [-2.0, 8.0], atol=1e-8)


# ---- on the sphere ----


def near_pole(rng, n, sign, radius_deg):
    """Directions about a pole, the pole itself under several longitudes among them."""
    distance = radius_deg * np.sqrt(rng.uniform(0, 1, n))
    distance[:4] = 0.0
    return rng.uniform(0, 360, n), sign * (90.0 - distance)


SKIES = {
    "equator": lambda rng, n: (rng.uniform(40, 40.1, n), rng.uniform(-0.05, 0.05, n)),
    "high latitude": lambda rng, n: (rng.uniform(10, 20, n), rng.uniform(89.5, 89.6, n)),
    "across 0/360": lambda rng, n: (rng.uniform(-0.05, 0.05, n) % 360.0, rng.uniform(30, 30.1, n)),
    "negative longitudes": lambda rng, n: (rng.uniform(-0.05, 0.05, n), rng.uniform(30, 30.1, n)),
    "antimeridian": lambda rng, n: (rng.uniform(179.95, 180.05, n), rng.uniform(-60.1, -60, n)),
    "north pole": lambda rng, n: near_pole(rng, n, 1, 0.05),
    "south pole": lambda rng, n: near_pole(rng, n, -1, 0.05),
    "at the very pole": lambda rng, n: near_pole(rng, n, 1, 1e-5),
}


@pytest.mark.slow
@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize("name", ["box", "radius"])
def test_candidates_on_the_sky_are_those_of_the_definition(sky, name):
    gate, definition = GATES[name]
    for seed, kinds in enumerate([("one sigma", "one sigma"), ("full", "axis sigmas"), ("full", "full")]):
        rng = np.random.default_rng([seed, len(sky)])
        first = sky_records(rng, *SKIES[sky](rng, 40), scale_arcsec=8.0, kind=kinds[0])
        second = sky_records(rng, *SKIES[sky](rng, 40), scale_arcsec=rng.choice([2.0, 15.0], 40), kind=kinds[1])
        assert_candidates(first, second, gate, definition)


@pytest.mark.slow
@pytest.mark.parametrize("scale_deg", [1.0, 6.0, 25.0])
@pytest.mark.parametrize("name", ["box", "radius"])
def test_candidates_of_gates_many_degrees_wide_are_those_of_the_definition(scale_deg, name):
    gate, definition = GATES[name]
    for seed, kind in enumerate(KINDS):
        rng = np.random.default_rng([seed, int(scale_deg)])
        whole = [(rng.uniform(0, 360, 45), np.degrees(np.arcsin(rng.uniform(-1, 1, 45)))) for _ in range(2)]
        whole[0][1][:2] = 90.0, -90.0
        first = sky_records(rng, *whole[0], scale_arcsec=3600 * scale_deg / 2, kind=kind)
        second = sky_records(rng, *whole[1], scale_arcsec=3600 * scale_deg / 2, kind=KINDS[2 - seed])
        assert_candidates(first, second, gate, definition, least=1 if scale_deg > 1 else 0)


def test_adding_360_degrees_to_longitudes_changes_nothing():
    rng = np.random.default_rng(3)
    lon, lat = SKIES["north pole"](rng, 40)
    first = sky_records(rng, lon, lat, scale_arcsec=20.0, kind="full")
    second = sky_records(rng, lon + 0.01, lat, scale_arcsec=20.0, kind="full")
    turned = Records(
        first.features + np.array([720.0, 0.0]), first.covariance, first.rows, first.ids, first.space, first.source
    )
    straight, around = Radius(3.0)(first, second), Radius(3.0)(turned, second)
    assert by_id(straight) == by_id(around)
    np.testing.assert_allclose(around.residual, straight.residual, rtol=0, atol=1e-6)
    np.testing.assert_allclose(around.covariance, straight.covariance, rtol=0, atol=1e-6)


# ---- errors and positions far from the bulk ----


@pytest.mark.slow
@pytest.mark.parametrize("factor", [40.0, 1000.0])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_candidates_of_a_few_records_with_far_larger_errors_in_a_plane(factor, d):
    rng = np.random.default_rng([int(factor), d])
    scales = [np.where(rng.uniform(size=n) < 0.03, 1e-3 * factor, 1e-3) for n in (150, 160)]
    records = [plane_records(rng, len(s), d, scale=s, kind="full") for s in scales]
    pairs = assert_candidates(*records)
    assert np.isin(pairs.i, np.flatnonzero(scales[0] > 1e-3)).any()


@pytest.mark.slow
def test_candidates_of_a_few_records_with_far_larger_errors_on_the_sky():
    rng = np.random.default_rng(5)
    scales = [np.where(rng.uniform(size=150) < 0.04, 200.0, 0.5) for _ in range(2)]
    records = [sky_records(rng, *SKIES["north pole"](rng, 150), scale_arcsec=s, kind="full") for s in scales]
    assert_candidates(*records)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_outliers_a_billion_away_are_found_too(d):
    rng = np.random.default_rng(d)
    first, second = (plane_records(rng, 80, d, scale=0.05) for _ in range(2))
    one, two = first.features.copy(), second.features.copy()
    one[:3] += 1e9
    two[:3] = one[:3] + 0.01
    two[3] -= 1e9
    first = Records(one, first.covariance, first.rows, first.ids, first.space)
    second = Records(two, second.covariance, second.rows, second.ids, second.space)
    pairs = Box(3.0)(first, second)
    found = set(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True))
    assert found == naive.candidates(first, second, sigmas=3.0)
    assert {(0, 0), (1, 1), (2, 2)} <= found


# ---- more records than a search holds at a time ----


def by_matrix(first, second, sigmas):
    """The pairs within ``sigmas``, for circular errors, from the matrix of all distances."""
    a, b = first.features, second.features
    if isinstance(first.space, Sphere):
        delta = sphere_offset(a[:, None, 0], a[:, None, 1], b[None, :, 0], b[None, :, 1])
    else:
        delta = a[:, None] - b[None]
        for axis, period in enumerate(first.space.period_list(first.d)):
            if math.isfinite(period):
                delta[..., axis] -= period * np.round(delta[..., axis] / period)
    spread = first.covariance + second.covariance[:, 0]
    return set(zip(*(x.tolist() for x in np.nonzero((delta**2).sum(axis=2) <= sigmas**2 * spread)), strict=True))


def some_wide(rng, n, sigma, share, factor):
    return np.where(rng.uniform(size=n) < share, factor * sigma, sigma * rng.uniform(0.3, 1.0, n))[:, None]


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("sky", [sky for sky in SKIES if sky != "at the very pole"])
@pytest.mark.parametrize("share", [(0.0, 0.0), (0.01, 0.0), (0.0, 0.01), (0.02, 0.01)])
def test_candidates_of_thousands_of_records_with_a_few_large_errors(sky, share):
    rng = np.random.default_rng([len(sky), int(1000 * sum(share))])
    sources = []
    for n, few in zip((700, 1000), share, strict=True):
        features = np.column_stack(SKIES[sky](rng, n))
        features[:50, 0] += 360.0  # the same positions, 360° added
        sources.append(Records.of(features, sigma=some_wide(rng, n, 2.0, few, 40.0), space=Sphere()))
    first, second = sources
    pairs = Radius(3.0)(first, second)
    found = list(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True))
    assert len(found) == len(set(found)) > 20
    assert set(found) == by_matrix(first, second, 3.0)
    # Sorted by place, and every record has one place.
    assert (np.diff(pairs.place_1) >= 0).all()
    for place, record in ((pairs.place_1, pairs.i), (pairs.place_2, pairs.j)):
        assert len(set(zip(place.tolist(), record.tolist(), strict=True))) == len(set(place.tolist()))


@pytest.mark.slow
@pytest.mark.parametrize("periods", [(None, None), (1.0, None), (None, 1.0), (1.0, 1.0)])
@pytest.mark.parametrize("wide_source", [0, 1])
def test_a_record_with_more_candidates_than_one_search_block(periods, wide_source):
    rng = np.random.default_rng(4)
    sources = []
    for source in range(2):
        sigma = np.full((9000 if source != wide_source else 300, 1), 1e-4)
        if source == wide_source:
            sigma[:3, 0] = 0.3, 0.1, 0.05
        features = rng.uniform(0, 1, (len(sigma), 2)) * [1.0, 0.5]
        sources.append(Records.of(features, sigma=sigma, space=Plane(periods)))
    first, second = sources
    pairs = Radius(1.5)(first, second)
    found = list(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True))
    counts = np.bincount((pairs.i, pairs.j)[wide_source])
    assert counts.max() > 4096
    assert len(found) == len(set(found))
    assert set(found) == by_matrix(first, second, 1.5)


@pytest.mark.slow
def test_candidates_in_distant_fields_and_clumps():
    rng = np.random.default_rng(6)
    sources = []
    for _ in range(2):
        fields = rng.choice([0.01, 120.0, 240.0, 359.9], 2000)
        features = np.column_stack([fields + rng.uniform(0, 0.05, 2000), 70.0 + 0.02 * rng.standard_normal(2000)])
        features[:600] = [120.02, 70.0] + 0.0005 * rng.standard_normal((600, 2))
        sources.append(Records.of(features, sigma=0.5, space=Sphere()))
    first, second = sources
    pairs = Radius(3.0)(first, second)
    assert set(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)) == by_matrix(first, second, 3.0)
    listed_alike(rng, first, second, gate=Radius(3.0), times=1)


# ---- degenerate scenes ----


@pytest.mark.parametrize("space", [Plane(), Plane((1.0, None)), Sphere()])
def test_many_records_at_one_place_are_all_candidates_of_each_other(space):
    for n in (1, 2, 300):
        first = Records.of(np.full((n, 2), 0.25), sigma=0.1, space=space)
        second = Records.of(np.full((3, 2), 0.25), sigma=0.1, space=space)
        assert len(Box(3.0)(first, second)) == 3 * n


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_records_on_a_line_along_an_axis(axis):
    rng = np.random.default_rng(axis)
    sides = []
    for _ in range(2):
        features = np.zeros((60, 2))
        features[:, axis] = rng.uniform(0, 1, 60)
        sides.append(Records.of(features, sigma=0.01))
    assert_candidates(*sides)


@pytest.mark.parametrize("n1,n2", [(0, 0), (0, 3), (3, 0)])
def test_an_empty_side_has_no_candidates(n1, n2):
    for space in (Plane(), Sphere()):
        first, second = (Records.of(np.zeros((n, 2)), sigma=1.0, space=space) for n in (n1, n2))
        pairs = ChiSquare()(first, second)
        assert len(pairs) == 0 and pairs.residual.shape == (0, 2) and pairs.covariance.shape == (0, 2, 2)


def test_one_record_of_each_source():
    first = Records.of([[0.0, 0.0]], sigma=1.0)
    assert_candidates(first, Records.of([[1.0, 1.0]], sigma=1.0))
    assert_candidates(first, Records.of([[10.0, 1.0]], sigma=1.0), least=0)


# ---- threads and the order of the listing ----


@pytest.mark.parametrize("sky", [False, True])
def test_threads_do_not_change_a_digit(monkeypatch, sky):
    rng = np.random.default_rng(8)
    if sky:
        records = [sky_records(rng, *SKIES["across 0/360"](rng, 500), scale_arcsec=20.0, kind="full") for _ in range(2)]
    else:
        records = [plane_records(rng, 500, 2, scale=0.03, kind="full", periods=(1.0, None)) for _ in range(2)]
    even = threads.even
    monkeypatch.setattr(threads, "even", lambda n, least=4096: even(n, 16))
    answers = []
    for count in ("1", "2", "5"):
        monkeypatch.setenv("SAMEAS_THREADS", count)
        answers.append(ChiSquare()(*records))
    assert len(answers[0]) > 1000
    for other in answers[1:]:
        for name in ("i", "j", "residual", "mahalanobis_sq", "determinant"):
            np.testing.assert_array_equal(getattr(other, name), getattr(answers[0], name))


def listed_alike(rng, first, second, gate=GATES["box"][0], times=4):
    for search in (lambda one, two: zone_search(one, two, gate), gate):
        expected = by_id(search(first, second))
        assert len(expected) > 1
        for _ in range(times):
            assert by_id(search(shuffled(rng, first), shuffled(rng, second))) == expected


@pytest.mark.slow
@pytest.mark.parametrize("d", [1, 2, 3])
def test_listing_does_not_depend_on_the_row_order(d):
    rng = np.random.default_rng(d)
    wide = np.where(rng.uniform(size=300) < 0.05, 50.0, 1.0)
    for scale in (0.01, 0.005 * wide):
        listed_alike(rng, *(plane_records(rng, 300, d, scale=scale, kind="full") for _ in range(2)))


def test_listing_of_equal_records_follows_their_ids():
    rng = np.random.default_rng(1)
    for features in (rng.integers(0, 4, (300, 2)) * 1.0, np.zeros((300, 2))):
        first = Records.of(features, sigma=0.5, ids=rng.permutation(300))
        second = Records.of(features[:20], sigma=0.5, ids=[f"s{k}" for k in rng.permutation(20)])
        listed_alike(rng, first, second)


def test_listing_of_equal_records_with_ids_of_mixed_kinds():
    first = Records.of(np.zeros((4, 1)), sigma=1.0, ids=np.array([1, "a", 2, "b"], dtype=object))
    second = Records.of(np.zeros((1, 1)), sigma=1.0)
    listed_alike(np.random.default_rng(0), Records.of(first.features, sigma=1.0, ids=first.ids), second)


@pytest.mark.slow
def test_listing_on_the_sky_does_not_depend_on_the_row_order():
    rng = np.random.default_rng(2)
    for sky in SKIES.values():
        listed_alike(rng, *(sky_records(rng, *sky(rng, 150), scale_arcsec=10.0, kind="full") for _ in range(2)))


# ---- words ----


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: ChiSquare(1.0), "completeness is 1.0; give a probability between 0 and 1"),
        (lambda: Radius(0.0), "sigmas is 0.0; give a positive number"),
        (lambda: Box(math.nan), "sigmas is nan; give a positive number"),
        (
            lambda: Box()(
                Records.of([1.0], sigma=1.0, source="radar"), Records.of([[1.0, 2.0]], sigma=1.0, source="ais")
            ),
            "radar has 1 features .* ais 2 .* bring both to one feature space",
        ),
        (
            lambda: Box()(Records.of([[1.0, 2.0]], sigma=1.0), Records.of([[1.0, 2.0]], sigma=1.0, space=Sphere())),
            "bring both to one feature space",
        ),
        (lambda: Plane((0.0,)), "period of axis 0 is 0.0; give a positive number or None"),
        (lambda: Records.of([1.0], sigma=1.0, space=Plane((1.0, 1.0))), "2 periods, but the records have 1 features"),
    ],
)
def test_invalid_gates_and_sources_are_refused_with_a_clear_message(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_pairs_carry_a_description_of_their_gate():
    first = Records.of([1.0], sigma=1.0)
    assert Box()(first, first).gate == "each feature within 3 σ"
    assert Radius(2.5)(first, first).gate == "distance ≤ 2.5 σ"
    assert "loses 1.0e-09 of the true" in ChiSquare()(first, first).gate
    # The default keeps 1 − 1e-9: √(−2 ln 1e-9) = 6.438 standard deviations in two features.
    assert math.sqrt(ChiSquare().limit(2)) == pytest.approx(math.sqrt(-2 * math.log(1e-9)), rel=1e-7)


def test_a_source_that_is_not_records_is_refused_with_how_to_make_them():
    records, positions = Records.of([[0.0, 0.0]], sigma=1.0), cast("Any", [[0.0, 0.0]])
    for gate in (ChiSquare(), Radius(3.0), Box()):
        with pytest.raises(InputError, match=r"a source is a list; make it with Records\.of\(features, sigma=…\)"):
            gate(positions, records)


def test_zones_of_distant_fields_cover_the_fields_only():
    """Zones sized by the bounding box of both fields would each hold a whole field."""
    from sameas.gate.zones import DEFAULT_TUNING, Extent, Geometry, Source

    rng = np.random.default_rng(3)
    fields = [rng.uniform(size=(4_000, 2)) * 0.1 + place for place in ((10.0, -50.0), (200.0, 60.0))]
    records = Records.of(np.concatenate(fields), sigma=0.1, space=Sphere())
    geometry = Geometry.of(records, records, 9.0, False, DEFAULT_TUNING)
    source = Source.of(records, geometry)
    covered = 0.01 * (np.cos(np.radians(50.0)) + np.cos(np.radians(60.0)))
    assert Extent.of((source, source), geometry).area < 30.0 * covered


@pytest.mark.parametrize("d", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("share", [1e-12, 0.01, 0.5, 0.99])
def test_quantiles_of_chi_square_agree_with_scipy(d, share):
    assert quantile(share, d) == pytest.approx(chi2.ppf(share, d), rel=1e-9)
    assert upper_quantile(share, d) == pytest.approx(chi2.isf(share, d), rel=1e-9)
