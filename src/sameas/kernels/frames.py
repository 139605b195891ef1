"""Compiled loops over the pixels of a frame: peaks, the saddles between them, windowed centroids, light of many stars.

The Gaussian window along a row of pixels is computed from its highest pixel outwards with two multiplications a pixel:
the ratio of neighbours, and the constant ratio of these ratios. Its relative error is below 1e-12 over 100 pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import borrowing_part, kernel

#: An image of either precision.
Pixels = NDArray[np.float32] | FloatArray

#: Columns of :func:`windowed`: position, Σ w I, Σ w I dd (xx, xy, yy), Σ w² v dd, Σ w² g I dd, Σ w² v, Σ w² g I,
#: Σ w² of usable pixels, Σ w², whether the window extends beyond the frame, whether the position converged.
X, Y, WEIGHT, MOMENTS, SKY, PHOTONS, SKY_SUM, PHOTON_SUM, USABLE, WHOLE, AT_EDGE, CONVERGED = (
    0, 1, 2, 3, 6, 9, 12, 13, 14, 15, 16, 17,
)  # fmt: skip
COLUMNS = 18


@kernel
def local_maxima(image: Pixels, threshold: float, reach: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pixels above a threshold that no pixel exceeds within ``reach`` along both axes."""
    rows, columns = image.shape
    capacity, found = 1024, 0
    y, x = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    for r in range(rows):
        for c in range(columns):
            value = image[r, c]
            if not value > threshold:
                continue
            highest = True
            for v in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for w in range(max(c - reach, 0), min(c + reach + 1, columns)):
                    if image[v, w] > value:
                        highest = False
                        break
                if not highest:
                    break
            if not highest:
                continue
            if found == capacity:
                capacity *= 2
                more_y, more_x = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
                for k in range(found):
                    more_y[k], more_x[k] = y[k], x[k]
                y, x = more_y, more_x
            y[found], x[found] = r, c
            found += 1
    return y[:found], x[:found]


@borrowing_part
def interpolated(image: Pixels, x: float, y: float) -> float:
    """The image at a point between pixels, bilinear; beyond the edge that of the edge."""
    rows, columns = image.shape
    x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
    c, r = min(int(x), columns - 2), min(int(y), rows - 2)
    u, v = x - c, y - r
    low = (1.0 - u) * image[r, c] + u * image[r, c + 1]
    return float((1.0 - v) * low + v * ((1.0 - u) * image[r + 1, c] + u * image[r + 1, c + 1]))


@kernel
def saddles(image: Pixels, one: FloatArray, two: FloatArray, points: int, aside: float) -> FloatArray:
    """(n,) lowest value on the way from points ``one`` to ``two`` (n, 2), at ``points`` places between them.

    A ridge may pass beside the straight line: at each place the highest of three lines counts, ``aside`` pixels apart.
    """
    lowest = np.empty(len(one))
    for k in range(len(one)):
        dx, dy = two[k, 0] - one[k, 0], two[k, 1] - one[k, 1]
        length = math.sqrt(dx * dx + dy * dy)
        across_x, across_y = -dy / length * aside, dx / length * aside
        lowest[k] = math.inf
        for p in range(1, points + 1):
            x, y = one[k, 0] + dx * p / (points + 1), one[k, 1] + dy * p / (points + 1)
            value = max(
                interpolated(image, x, y),
                interpolated(image, x - across_x, y - across_y),
                interpolated(image, x + across_x, y + across_y),
            )
            lowest[k] = min(lowest[k], value)
    return lowest


@kernel
def add_stamps(image: Pixels, x: IntArray, y: IntArray, stamps: FloatArray) -> None:
    """Add stamps (n, k, k), whose first pixels are at ``x``, ``y`` (n,), to the image, as far as they are inside it."""
    rows, columns = image.shape
    n, k, _ = stamps.shape
    for star in range(n):
        for v in range(max(0, -y[star]), min(k, rows - y[star])):
            for w in range(max(0, -x[star]), min(k, columns - x[star])):
                image[y[star] + v, x[star] + w] += stamps[star, v, w]


@kernel
def take_away(image: Pixels, rows: IntArray, columns: IntArray, stamp: Pixels) -> None:
    """Subtract a stamp (k, k), k odd, centred on each of the pixels."""
    half = len(stamp) // 2
    for n in range(len(rows)):
        for v in range(max(rows[n] - half, 0), min(rows[n] + half + 1, image.shape[0])):
            for w in range(max(columns[n] - half, 0), min(columns[n] + half + 1, image.shape[1])):
                image[v, w] -= stamp[v - rows[n] + half, w - columns[n] + half]


@borrowing_part
def fill_window(
    weight: FloatArray, x: float, y: float, left: int, low: int, size: int, a: float, b: float, c: float
) -> None:
    """exp(−½ (a dx² + 2 b dx dy + c dy²)) about a position, in the first ``size`` rows and columns of ``weight``."""
    bend = math.exp(-a)
    for v in range(size):
        dy = low + v - y
        peak = min(max(round(x - b * dy / a) - left, 0), size - 1)
        dx = left + peak - x
        top = math.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
        weight[v, peak] = top
        value, ratio = top, math.exp(-0.5 * a * (2.0 * dx + 1.0) - b * dy)
        for w in range(peak + 1, size):
            value *= ratio
            ratio *= bend
            weight[v, w] = value
        value, ratio = top, math.exp(0.5 * a * (2.0 * dx - 1.0) + b * dy)
        for w in range(peak - 1, -1, -1):
            value *= ratio
            ratio *= bend
            weight[v, w] = value


@kernel
def windowed(
    light: Pixels, variance: Pixels, start: FloatArray, inverse: FloatArray, half: IntArray, limit: FloatArray,
    own: FloatArray, profile: FloatArray, inverse_gain: float, steps: int, short: float,
) -> FloatArray:  # fmt: skip
    """(n, COLUMNS) centroids in Gaussian windows, x ← x + 2 Σ w I d / Σ w I, and the sums at the last position.

    light, variance : (rows, columns) above the sky, and of a pixel of the sky, infinite where unusable.
    start : (n, 2) x, y. inverse : (n, 3) of the window's matrix, xx, xy, yy. half : (n,) of the stamps, px.
    limit : (n,) a step is at most half of it, and a position at most 0.5 + 0.8 of it from the start, where it stays if
    it would leave. own : (n, 3) x, y and flux of the star's light that was taken out of ``light``; flux 0 for none.
    profile : (6,) of that light: inverse matrix xx, xy, yy, scale, norm, exponent. short : a step that ends the search.
    """
    rows, columns = light.shape
    n, most = len(start), 0
    for k in range(n):
        most = max(most, 2 * half[k] + 1)
    out = np.zeros((n, COLUMNS))
    stamp, sky, weight = np.empty((most, most)), np.empty((most, most)), np.empty((most, most))
    for k in range(n):
        size = 2 * half[k] + 1
        left, low = int(np.rint(start[k, 0])) - half[k], int(np.rint(start[k, 1])) - half[k]
        for v in range(size):
            for w in range(size):
                r, q = low + v, left + w
                inside = r >= 0 and r < rows and q >= 0 and q < columns
                if not inside or not math.isfinite(variance[r, q]):
                    stamp[v, w], sky[v, w] = 0.0, -1.0
                    continue
                stamp[v, w], sky[v, w] = light[r, q], variance[r, q]
                if own[k, 2] != 0.0:
                    dx, dy = q - own[k, 0], r - own[k, 1]
                    r2 = profile[0] * dx * dx + 2.0 * profile[1] * dx * dy + profile[2] * dy * dy
                    stamp[v, w] += own[k, 2] * (profile[4] * (1.0 + profile[3] * r2) ** -profile[5])
        a, b, c = inverse[k]
        x, y = start[k]
        farthest, converged = 0.5 + 0.8 * limit[k], False
        for _ in range(steps):
            fill_window(weight, x, y, left, low, size, a, b, c)
            total, first_x, first_y = 0.0, 0.0, 0.0
            for v in range(size):
                row_total, row_x = 0.0, 0.0
                for w in range(size):
                    wi = weight[v, w] * stamp[v, w]
                    row_total += wi
                    row_x += wi * (left + w - x)
                total += row_total
                first_x += row_x
                first_y += row_total * (low + v - y)
            step_x, step_y = 2.0 * first_x / total, 2.0 * first_y / total
            valid = math.isfinite(step_x) and math.isfinite(step_y) and total > 0.0
            if not valid:
                break
            step_x = min(max(step_x, -0.5 * limit[k]), 0.5 * limit[k])
            step_y = min(max(step_y, -0.5 * limit[k]), 0.5 * limit[k])
            x += step_x
            y += step_y
            converged = abs(step_x) < short and abs(step_y) < short
            if converged or abs(x - start[k, 0]) > farthest or abs(y - start[k, 1]) > farthest:
                break
        if abs(x - start[k, 0]) > farthest or abs(y - start[k, 1]) > farthest:
            x, y, converged = start[k, 0], start[k, 1], False
        fill_window(weight, x, y, left, low, size, a, b, c)
        out[k, X], out[k, Y], out[k, CONVERGED] = x, y, converged
        out[k, AT_EDGE] = left < 0 or low < 0 or left + size > columns or low + size > rows
        weight_sum, sky_sum, photon_sum, usable, whole = 0.0, 0.0, 0.0, 0.0, 0.0
        i_xx, i_xy, i_yy, n_xx, n_xy, n_yy, p_xx, p_xy, p_yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for v in range(size):
            dy = low + v - y
            for w in range(size):
                dx = left + w - x
                wi, w2 = weight[v, w] * stamp[v, w], weight[v, w] * weight[v, w]
                whole += w2
                if sky[v, w] < 0.0:
                    continue
                noise, photons = w2 * sky[v, w], w2 * stamp[v, w] * inverse_gain
                weight_sum += wi
                sky_sum += noise
                photon_sum += photons
                usable += w2
                xx, xy, yy = dx * dx, dx * dy, dy * dy
                i_xx += wi * xx
                i_xy += wi * xy
                i_yy += wi * yy
                n_xx += noise * xx
                n_xy += noise * xy
                n_yy += noise * yy
                p_xx += photons * xx
                p_xy += photons * xy
                p_yy += photons * yy
        out[k, WEIGHT], out[k, SKY_SUM], out[k, PHOTON_SUM] = weight_sum, sky_sum, photon_sum
        out[k, USABLE], out[k, WHOLE] = usable, whole
        out[k, MOMENTS], out[k, MOMENTS + 1], out[k, MOMENTS + 2] = i_xx, i_xy, i_yy
        out[k, SKY], out[k, SKY + 1], out[k, SKY + 2] = n_xx, n_xy, n_yy
        out[k, PHOTONS], out[k, PHOTONS + 1], out[k, PHOTONS + 2] = p_xx, p_xy, p_yy
    return out
