"""The compiled loops over the pixels of a frame give the results of plain NumPy and SciPy."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter, zoom

from sameas.kernels import frames
from sameas.sky.frame.centroid import PSF, Background, Subtracted, centroids, interpolated
from sameas.sky.frame.peaks import usable_share


@pytest.mark.parametrize("reach", [1, 2, 4])
def test_local_maxima_are_those_of_a_maximum_filter(reach):
    rng = np.random.default_rng(reach)
    image = np.round(rng.normal(size=(70, 50)), 1).astype(np.float32)  # rounded: equal neighbours are both maxima
    image[::9, ::7] += 5
    y, x = frames.local_maxima(image, 0.5, reach)
    expected = np.nonzero((image == maximum_filter(image, 2 * reach + 1)) & (image > 0.5))
    assert len(y) > 30 and np.array_equal(y, expected[0]) and np.array_equal(x, expected[1])


def test_saddles_are_the_lowest_of_three_interpolated_lines():
    rng = np.random.default_rng(2)
    image = rng.normal(size=(40, 60))
    one, two = rng.uniform([0, 0], [59, 39], (50, 2)), rng.uniform([-2, -2], [61, 41], (50, 2))
    step = (two - one) / np.linalg.norm(two - one, axis=1, keepdims=True)
    across = np.column_stack([-step[:, 1], step[:, 0]])[:, None, :]
    line = one[:, None, :] + np.linspace(0, 1, 9)[1:-1, None] * (two - one)[:, None, :]
    sampled = [
        map_coordinates(image, [points[..., 1], points[..., 0]], order=1, mode="nearest")
        for points in (line - 0.6 * across, line, line + 0.6 * across)
    ]
    assert frames.saddles(image, one, two, 7, 0.6) == pytest.approx(np.max(sampled, axis=0).min(axis=1), abs=1e-12)


def test_stamps_are_added_and_taken_away_inside_the_image():
    rng = np.random.default_rng(3)
    stamps, wide = rng.normal(size=(6, 5, 5)), np.zeros((40, 50))
    x, y = np.array([-3, 0, 17, 28, 12, -9]), np.array([2, -4, 10, 19, 17, 5])
    for column, row, stamp in zip(x, y, stamps, strict=True):
        wide[10 + row : 15 + row, 10 + column : 15 + column] += stamp
    image = np.zeros((20, 30))
    frames.add_stamps(image, x, y, stamps)
    assert np.allclose(image, wide[10:30, 10:40])
    frames.take_away(image, y[2:5] + 2, x[2:5] + 2, stamps[0])
    for column, row in zip(x[2:5], y[2:5], strict=True):
        wide[10 + row : 15 + row, 10 + column : 15 + column] -= stamps[0]
    assert np.allclose(image, wide[10:30, 10:40])


@pytest.mark.parametrize("shape", [(60, 41), (12, 70), (9, 8)])
def test_the_usable_share_of_a_kernel_is_that_of_a_convolution(shape):
    rng = np.random.default_rng(4)
    usable = rng.random(shape) > 0.1
    usable[:, 5] = False
    across = np.arange(-6, 7)
    kernel = np.exp(-0.2 * across[:, None] ** 2 - 0.1 * across * across[:, None] - 0.3 * across**2).astype(np.float32)
    padded = np.pad(usable.astype(float), 6)
    expected = sum(
        kernel[v, w] * padded[v : v + shape[0], w : w + shape[1]] for v in range(13) for w in range(13)
    ) / kernel.sum(dtype=float)
    assert usable_share(usable, kernel) == pytest.approx(expected, abs=1e-5)


def test_a_mesh_is_interpolated_by_bicubic_splines_within_its_range():
    mesh = np.random.default_rng(5).normal(100.0, 3.0, (5, 8))
    expected = np.clip(zoom(mesh, 16, order=3, mode="reflect", grid_mode=True), mesh.min(), mesh.max())[:75, :120]
    # A spline of one axis after the other, with the same finite edges: 1e-6 of the range.
    assert interpolated(mesh, 16, (75, 120)) == pytest.approx(expected, abs=1e-4)


def in_numpy(light, background, start, window, own, steps=25, short=2e-4):
    """Position, Σ w I, moments, covariance of the first moment, variance of Σ w I of one star, by the definitions."""
    y, x = np.mgrid[: light.shape[0], : light.shape[1]].astype(float)
    usable = np.isfinite(background.variance)
    star = np.where(usable, light + (0 if own is None else own.flux[0] * own.psf.light(*(
        grid - at for grid, at in zip((x, y), own.xy[0], strict=True)
    ))), 0.0)  # fmt: skip
    reach = np.ceil(3.5 * np.linalg.eigvalsh(window)[1] ** 0.5) + 1
    half = next(size for size in (4, 6, 7, 9, 12, 15, 20, 26, 33) if size >= reach)
    near = (np.abs(x - np.rint(start[0])) <= half) & (np.abs(y - np.rint(start[1])) <= half)
    inverse, position = np.linalg.inv(window), np.array(start, float)
    for _ in range(steps):
        d = np.stack([x - position[0], y - position[1]], axis=-1)
        w = np.where(near, np.exp(-0.5 * np.einsum("yxa,ab,yxb->yx", d, inverse, d)), 0.0)
        step = 2 * np.einsum("yx,yxa->a", w * star, d) / (w * star).sum()
        position = position + np.clip(step, -0.5 * np.trace(window) ** 0.5, 0.5 * np.trace(window) ** 0.5)
        if (np.abs(step) < short).all():
            break
    d = np.stack([x - position[0], y - position[1]], axis=-1)
    w = np.where(near, np.exp(-0.5 * np.einsum("yxa,ab,yxb->yx", d, inverse, d)), 0.0)
    variance = np.where(usable, background.variance, 0.0) + star * background.inverse_gain
    return (
        position, (w * star).sum(), np.einsum("yx,yxa,yxb->ab", w * star, d, d) / (w * star).sum(),
        np.einsum("yx,yxa,yxb->ab", w**2 * variance, d, d), (w**2 * variance).sum(),
    )  # fmt: skip


@pytest.mark.parametrize("taken_out", [False, True])
@pytest.mark.parametrize("elongation", [1.0, 9.0])
def test_centroids_are_the_zeros_of_the_first_moment(taken_out, elongation):
    rng = np.random.default_rng(6)
    psf = PSF(np.array([[2.0 * elongation, 0.5], [0.5, 1.6]]), 3.0)
    y, x = np.mgrid[:60, :70]
    xy = np.array([[30.3, 25.8], [3.2, 40.1], [66.9, 57.4]])
    stars = [4e4 * psf.light(x - a, y - b) for a, b in xy]
    variance = np.full((60, 70), 25.0, np.float32)
    variance[24, 33], variance[:, 50] = np.inf, np.inf
    background = Background(np.zeros((60, 70), np.float32), variance, 0.4, np.eye(1))
    sky = rng.normal(0.0, 5.0, (60, 70))
    subtracted = Subtracted(xy, np.full(3, 4e4), psf) if taken_out else None
    light = (sky if taken_out else sky + sum(stars)).astype(np.float32)
    windows = np.broadcast_to(psf.window(), (3, 2, 2))
    found = centroids(light, background, np.rint(xy), windows, subtracted)
    for k in range(3):
        own = None if subtracted is None else Subtracted(xy[[k]], subtracted.flux[[k]], psf)
        position, weight, moments, first, total = in_numpy(light, background, np.rint(xy[k]), windows[k], own)
        assert found.converged[k] and found.xy[k] == pytest.approx(position, abs=1e-7)
        assert found.weight[k] == pytest.approx(weight, rel=1e-8) and found.moments[k] == pytest.approx(
            moments, rel=1e-6
        )
        assert found.moment_covariance[k] == pytest.approx(first, rel=1e-5, abs=1e-6 * np.trace(first))
        assert found.weight_variance[k] == pytest.approx(total, rel=1e-6)
    assert found.at_edge.tolist() == [False, True, True]
