"""The convex outline of a field."""

import numpy as np
import pytest

from sameas import Plane, Records, Sphere
from sameas.estimate.cells import ConvexRegion
from sameas.estimate.coverage import Coverage

LOW, HIGH = np.zeros(2), np.full(2, 10.0)


def disc(rng, n, radius=5.0):
    angle, away = rng.uniform(0.0, 2.0 * np.pi, n), radius * np.sqrt(rng.uniform(size=n))
    return 5.0 + np.column_stack([away * np.cos(angle), away * np.sin(angle)])


def turned(rng, n, degrees):
    at = rng.uniform(-3.5, 3.5, (n, 2))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return 5.0 + at @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize(
    ("draw", "area"), [(disc, 25.0 * np.pi), (lambda rng, n: turned(rng, n, 45.0), 49.0)], ids=["disc", "turned square"]
)
@pytest.mark.parametrize("n", [150, 2000])
def test_the_area_of_a_convex_field_is_found_without_bias(draw, area, n):
    found = []
    for seed in range(60):
        points = draw(np.random.default_rng([seed, n]), n)
        outline = ConvexRegion.of(points, points.min(axis=0), points.max(axis=0), n)
        assert outline is not None
        found.append(outline.area / area)
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - 1.0) < 4.0 * error + 0.002


def test_rectangles_and_a_few_points_have_no_outline():
    rng = np.random.default_rng(1)
    for n in (99, 100, 1000, 20_000):
        points = rng.uniform(0.0, 10.0, (n, 2))
        assert ConvexRegion.of(points, LOW, HIGH, n) is None
    assert ConvexRegion.of(disc(rng, 99), LOW, HIGH, 99) is None
    line = np.column_stack([rng.uniform(0.0, 10.0, 200), np.full(200, 5.0)])
    assert ConvexRegion.of(line, line.min(axis=0), line.max(axis=0), 200) is None
    diagonal = np.repeat(rng.uniform(0.0, 10.0, (200, 1)), 2, axis=1)
    assert ConvexRegion.of(diagonal, LOW, HIGH, 200) is None or ConvexRegion.of(diagonal, LOW, HIGH, 200).area < 1.0


@pytest.mark.parametrize("cells", [1, 3, 16, 50])
def test_the_covered_parts_of_cells_agree_with_random_points(cells):
    rng = np.random.default_rng(2)
    outline = ConvexRegion.of(disc(rng, 5000), LOW, HIGH, 5000)
    i, j = np.divmod(np.arange(cells**2), cells)
    low = np.column_stack([i, j]) * (10.0 / cells)
    part = outline.part(low, low + 10.0 / cells)
    assert part.mean() * 100.0 == pytest.approx(outline.area, rel=0.01)
    strewn = rng.uniform(0.0, 1.0, (4000, 2))
    for c in rng.permutation(cells**2)[:25]:
        x, y = (low[c] + strewn * (10.0 / cells)).T
        inside = (y > np.interp(x, outline.x, outline.lower)) & (y < np.interp(x, outline.x, outline.upper))
        inside &= (x > outline.x[0]) & (x < outline.x[-1])
        assert part[c] == pytest.approx(inside.mean(), abs=0.04)


@pytest.mark.parametrize("space", [Plane(), Sphere()])
def test_densities_in_a_cone_field_are_unbiased(space):
    rng = np.random.default_rng(3)
    ratio = []
    for _ in range(10):
        one, two = (disc(rng, n) - 5.0 for n in (400, 3000))
        if isinstance(space, Sphere):  # half a degree from the pole and across longitude 0
            one, two = (np.column_stack([x / 10.0 / np.cos(np.radians(70.0)) % 360.0, 70.0 + y / 10.0])
                        for x, y in (one.T, two.T))  # fmt: skip
        area = 25.0 * np.pi * (360.0**2 if isinstance(space, Sphere) else 1.0)
        cover = Coverage.of(*(Records.of(at, sigma=1e-3, space=space) for at in (one, two)))
        (of_1, _), (_, of_2) = cover.covered_densities
        ratio.append([400 / area / of_1.mean(), 3000 / area / of_2.mean(), cover.common_volume / area])
    np.testing.assert_allclose(np.mean(ratio, axis=0), 1.0, atol=0.03)


def test_the_order_of_the_records_does_not_matter():
    rng = np.random.default_rng(4)
    points = disc(rng, 700)
    one, two = (ConvexRegion.of(at, LOW, HIGH, 700) for at in (points, points[::-1]))
    assert one.area == pytest.approx(two.area, rel=1e-12)
    np.testing.assert_allclose(one.x, two.x, rtol=1e-12)
