"""One source queried within a radius around each record of the other: densities are those inside the discs."""

import math

import numpy as np
import pytest

import sameas
from sameas import Records, Sphere
from sameas.estimate.coverage import Coverage
from sameas.simulate.scenes import LonLatBox
from sameas.space import displaced

WIDE, NARROW = LonLatBox((0.0, 360.0), (-70.0, 70.0)), LonLatBox((149.0, 151.0), (1.0, 3.0))


def within(rng, n, radius):
    """(n, 2) offsets spread evenly over a disc."""
    angle, r = 2.0 * math.pi * rng.random(n), radius * np.sqrt(rng.random(n))
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


def queried(rng, area, n, radius, mean, share=0.7, sigma=(0.5, 0.1)):
    """Targets, and what a second catalogue has within ``radius`` of each; (n,) and (m,) labels of the objects.

    mean : number of unrelated records in a disc. share : of the targets that the second catalogue has.
    """
    target = area.draw(rng, n)
    partner = np.flatnonzero(rng.random(n) < share)
    error = rng.normal(size=(len(partner), 2)) * math.hypot(*sigma)
    number = rng.poisson(mean * np.exp(rng.normal(-0.5, 1.0, n)))
    position = np.concatenate(
        [displaced(target[partner], error)]
        + [displaced(np.tile(at, (k, 1)), within(rng, k, radius)) for at, k in zip(target, number, strict=True)]
    )
    label = np.concatenate([partner, np.full(number.sum(), -1)])
    order = rng.permutation(len(position))
    first = Records.of(target, sigma=sigma[0], space=Sphere(), source="targets")
    return first, Records.of(position[order], sigma=sigma[1], space=Sphere(), source="Gaia"), np.arange(n), label[order]


@pytest.mark.slow
@pytest.mark.parametrize("area", [WIDE, NARROW])
@pytest.mark.parametrize(("n", "radius", "mean"), [(300, 10.0, 1.0), (60, 60.0, 3.0), (150, 30.0, 20.0)])
def test_of_cone_searches_around_targets_as_many_pairs_are_wrong_as_expected(area, n, radius, mean):
    wrong, expected, variance = 0, 0.0, 0.0
    for seed in range(3):
        first, second, objects, of = queried(np.random.default_rng(seed), area, n, radius, mean)
        for swapped in (False, True):
            found = sameas.match(second, first) if swapped else sameas.match(first, second)
            rows = [np.asarray(found.pairs[name]) for name in ("row_1", "row_2")][:: -1 if swapped else 1]
            p = np.asarray(found.pairs["p_match"])
            wrong += int(np.count_nonzero(objects[rows[0]] != of[rows[1]]))
            expected, variance = expected + found.expected_wrong, variance + float((p * (1.0 - p)).sum())
            assert found.estimate.coverage.discs.centres == 1 + swapped
    assert abs(wrong - expected) < 3.0 * math.sqrt(2.0 * variance) + 2.0


def test_the_area_is_that_of_all_discs_and_what_overlaps_counts_once():
    rng = np.random.default_rng(3)
    target = NARROW.draw(rng, 50)
    target = np.concatenate([target, displaced(target[:20], np.full((20, 2), 4.0))])  # 5.66 arcsec apart
    position = np.concatenate([displaced(target, within(rng, len(target), 10.0)) for _ in range(30)])
    coverage = Coverage.of(*(Records.of(some, sigma=0.1, space=Sphere()) for some in (target, position)))
    half = math.hypot(4.0, 4.0) / 2.0 / 10.0
    common = 2.0 * (math.acos(half) - half * math.sqrt(1.0 - half**2))
    assert coverage.discs.radius == pytest.approx(10.0, rel=0.01)
    assert coverage.volume == pytest.approx(100.0 * (70.0 * math.pi - 20.0 * common), rel=0.03)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("n", [200, 3000])
def test_a_field_that_both_observe_is_not_taken_for_discs(share, n):
    """Also where all records of one source have a partner: then they lie within their errors of it."""
    rng = np.random.default_rng(n)
    one = NARROW.draw(rng, n)
    some = one[: max(50, n // 10)]
    errors = rng.standard_t(3, size=(len(some), 2))
    two = np.where(rng.random((len(some), 1)) < share, displaced(some, errors), NARROW.draw(rng, len(some)))
    coverage = Coverage.of(*(Records.of(points, sigma=1.0, space=Sphere()) for points in (one, two)))
    assert coverage.discs is None


@pytest.mark.parametrize("moved", ["shifted", "rotated"])
@pytest.mark.parametrize("n", [10, 40, 300])
def test_an_offset_between_two_catalogues_is_not_taken_for_discs(moved, n):
    """All residuals of a shift are of one length; those of a rotation fill a disc evenly, in all directions."""
    one = NARROW.draw(np.random.default_rng(n), n)
    from_middle = (one - (150.0, 2.0)) * 3600.0
    shift = np.full((n, 2), 0.7) if moved == "shifted" else 1e-3 * from_middle[:, ::-1] * (-1.0, 1.0)
    coverage = Coverage.of(*(Records.of(x, sigma=1.0, space=Sphere()) for x in (one, displaced(one, shift))))
    assert coverage.discs is None


def test_the_report_says_that_the_field_consists_of_discs():
    first, second, *_ = queried(np.random.default_rng(1), WIDE, 100, 10.0, 2.0)
    one, two = ({"ra": records.features[:, 0], "dec": records.features[:, 1]} for records in (first, second))
    found = sameas.match(one, two, sigma1=0.5, sigma2=0.1, names=("targets", "Gaia"))
    report = " ".join(found.report().split())
    assert "field discs of 10 arcsec around the records of targets: Gaia has none elsewhere" in report


def both_queried(rng, area, n, radius, mean, listed=True):
    """Two catalogues, both queried within ``radius`` of the same targets; labels of their objects.

    mean : number of other objects in a disc. listed : whether the targets are among the objects.
    """
    target = area.draw(rng, n)
    number = rng.poisson(mean, n)
    others = [displaced(np.tile(at, (k, 1)), within(rng, k, radius)) for at, k in zip(target, number, strict=True)]
    objects = np.concatenate([target, *others] if listed else others)
    sides, labels = [], []
    for share, sigma in ((0.6, 0.4), (0.5, 0.5)):
        of = np.flatnonzero(rng.random(len(objects)) < share)
        at = displaced(objects[of], sigma * rng.normal(size=(len(of), 2)))
        sides.append(Records.of(at, sigma=sigma, space=Sphere(), source=f"σ {sigma}"))
        labels.append(of)
    return *sides, *labels


@pytest.mark.slow
@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize(
    ("n", "radius", "mean"), [(300, 60.0, 4.0), (200, 15.0, 3.0), (60, 60.0, 60.0), (1000, 60.0, 20.0)]
)
def test_of_two_cone_searches_around_the_same_targets_as_many_pairs_are_wrong_as_expected(n, radius, mean, listed):
    """The sky between the discs counted as a part of the field: five to seven times as many were wrong as expected.

    Of a thousand discs half overlap another one: these were taken for one, and no discs were found.
    """
    wrong, expected, variance = 0, 0.0, 0.0
    for seed in range(3):
        first, second, of_first, of_second = both_queried(np.random.default_rng(seed), NARROW, n, radius, mean, listed)
        found = sameas.match(first, second)
        p = np.asarray(found.pairs["p_match"])
        rows = [np.asarray(found.pairs[name]) for name in ("row_1", "row_2")]
        wrong += int(np.count_nonzero(of_first[rows[0]] != of_second[rows[1]]))
        expected, variance = expected + found.expected_wrong, variance + float((p * (1.0 - p)).sum())
        discs = found.estimate.coverage.discs
        assert discs.centres == 0 and 0.75 * radius < discs.radius < 1.3 * radius
        assert 0.7 * n < len(discs.area) < 1.3 * n
    assert abs(wrong - expected) < 3.0 * math.sqrt(2.0 * variance) + 2.0


@pytest.mark.parametrize("extent", [5.0, 60.0])
def test_clusters_and_couples_in_a_field_are_not_taken_for_discs(extent):
    rng = np.random.default_rng(1)
    centre = NARROW.draw(rng, 150)
    clusters = displaced(np.repeat(centre, 6, axis=0), extent * rng.standard_t(3, size=(900, 2)))
    sides = [np.concatenate([clusters[rng.random(900) < 0.7], NARROW.draw(rng, 1500)]) for _ in range(2)]
    assert Coverage.of(*(Records.of(points, sigma=0.3, space=Sphere()) for points in sides)).discs is None
