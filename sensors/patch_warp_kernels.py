"""Compiled resampling of image patches, see `rbpf.sensors.patches`."""

import math

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def warp_all(sources, affines, templates):
    """Fills templates (K, size, size) from sources (K, S, S) and affines (K, 2, 2)."""
    for k in range(templates.shape[0]):
        warp_one(sources[k], affines[k], templates[k])


@njit(cache=True, error_model="numpy")
def warp_one(source, affine, template):
    """One template; NaN where its support leaves the source."""
    size, middle = template.shape[0], 0.5 * (source.shape[0] - 1)
    template[:] = np.nan
    a, b, c, d = affine[0, 0], affine[0, 1], affine[1, 0], affine[1, 1]
    if not math.isfinite(a * a + b * b + c * c + d * d):
        return
    samples = footprint(a, b, c, d, source.shape[0])
    reach = 0.0
    for s in range(samples.shape[0]):
        reach = max(reach, abs(samples[s, 0]), abs(samples[s, 1]))
    if max(abs(a) + abs(b), abs(c) + abs(d)) * (size // 2) + reach > middle:
        return
    for j in range(size):
        for i in range(size):
            dx, dy, total = float(i - size // 2), float(j - size // 2), 0.0
            x, y = middle + a * dx + b * dy, middle + c * dx + d * dy
            for s in range(samples.shape[0]):
                total += cubic(source, x + samples[s, 0], y + samples[s, 1])
            template[j, i] = total / samples.shape[0]


@njit(cache=True, error_model="numpy")
def footprint(a, b, c, d, most):
    """Offsets (m, 2) in the source whose mean is what a pixel of the template gathers.

    A pixel of the template covers A of a source pixel's square. The source's own pixels are squares already, so
    what is missing has the covariance (A Aᵀ − I)/12, no less than 0 along each of its axes.
    """
    uu, uv, vv = a * a + b * b, a * c + b * d, c * c + d * d
    angle = 0.5 * math.atan2(2.0 * uv, uu - vv)
    middle, half = 0.5 * (uu + vv), math.hypot(0.5 * (uu - vv), uv)
    along, across = math.sqrt(max(middle + half - 1.0, 0.0)), math.sqrt(max(middle - half - 1.0, 0.0))
    m, n = 1 + min(math.ceil(along), most), 1 + min(math.ceil(across), most)
    cosine, sine = math.cos(angle), math.sin(angle)
    samples = np.empty((m * n, 2))
    for p in range(m):
        for q in range(n):
            e, f = _step(along, p, m), _step(across, q, n)
            samples[p * n + q, 0] = cosine * e - sine * f
            samples[p * n + q, 1] = sine * e + cosine * f
    return samples


@njit(cache=True, error_model="numpy")
def _step(width, index, count):
    """The place of one of `count` equal steps around 0 that have the variance of a box of this width."""
    if count == 1:
        return 0.0
    return width * (index - 0.5 * (count - 1)) / math.sqrt(count * count - 1.0)


@njit(cache=True, error_model="numpy")
def cubic(image, x, y):
    """Catmull-Rom interpolation at column x and row y inside the image; its border is repeated."""
    height, width = image.shape
    u, v = min(int(x), width - 1), min(int(y), height - 1)
    across, down = weights(x - u), weights(y - v)
    total = 0.0
    for j in range(4):
        row = min(max(v + j - 1, 0), height - 1)
        line = 0.0
        for i in range(4):
            line += across[i] * image[row, min(max(u + i - 1, 0), width - 1)]
        total += down[j] * line
    return total


@njit(cache=True, error_model="numpy", inline="always")
def weights(t):
    """Catmull-Rom weights of the samples at −1, 0, 1, 2 for a place t in 0..1."""
    s = 1.0 - t
    return (
        -0.5 * t * s * s,
        1.0 + t * t * (1.5 * t - 2.5),
        1.0 + s * s * (1.5 * s - 2.5),
        -0.5 * s * t * t,
    )


@njit(cache=True, error_model="numpy")
def cut_window(image, x, y, window):
    """Fills window (S, S) uint8 around column x and row y."""
    half = window.shape[0] // 2
    for j in range(window.shape[0]):
        for i in range(window.shape[0]):
            grey = cubic(image, x + (i - half), y + (j - half))
            window[j, i] = np.uint8(min(max(math.floor(grey + 0.5), 0.0), 255.0))
