"""Compiled search of image patches: one template in one ellipse at a time, see `rbpf.sensors.patches`."""

import math
from pathlib import Path

import numpy as np
from numba import njit, prange

from rbpf.kernels.stale import discard_stale
from rbpf.sensors.patch_correlation_kernels import ellipse, normalised, score_ellipse
from rbpf.sensors.patch_refinement_kernels import refine

APART_PX = 3
"""Two peaks of the score are two places from this distance on, along rows or columns."""
OUTSIDE = np.float32(-2.0)
"""In a map of scores: not searched."""

discard_stale(Path(__file__).parent)


@njit(cache=True, error_model="numpy", parallel=True)
def search_all(image, templates, centres, covs, limits, found):
    """Fills found (K, 7) = u, v, score, second score, cov_uu, cov_uv, cov_vv.

    limits = (sigmas, most_px, least_std). What was not found keeps what the caller put there.
    """
    for k in prange(templates.shape[0]):
        search_one(image, templates[k], centres[k], covs[k], limits, found[k])


@njit(cache=True, error_model="numpy")
def search_one(image, template, centre, cov, limits, found):
    """One template in one ellipse."""
    unit = normalised(template, limits[2])
    if unit.shape[0] == 0:
        return
    columns, rows = interval(centre, cov, limits, image.shape, template.shape[0])
    width, height = columns[1] - columns[0] + 1, rows[1] - rows[0] + 1
    if width <= 0 or height <= 0:
        return
    scores = np.full((height, width), OUTSIDE, np.float32)
    score_ellipse(image, unit, template.shape[0], centre, cov, limits[0], columns, rows, scores)
    v, u = best(scores)
    if scores[v, u] <= -1.0:
        return
    found[2] = scores[v, u]
    refine(image, unit, template.shape[0], columns[0] + u, rows[0] + v, found)
    p, q = second(scores, v, u)
    if p >= 0:
        other = np.full(found.shape[0], float(scores[p, q]))
        refine(image, unit, template.shape[0], columns[0] + q, rows[0] + p, other)
        keep_better(found, other)


@njit(cache=True, error_model="numpy")
def keep_better(found, other):
    """The better of two peaks, with the other one's score as the second."""
    found[3] = other[2]
    if other[2] > found[2]:
        other[3] = found[2]
        found[:] = other


@njit(cache=True, error_model="numpy")
def interval(centre, cov, limits, shape, size):
    """First and last column and row of the whole pixels to search; empty where the last is before the first."""
    sigmas, most, half = limits[0], limits[1], size // 2
    uu, _, vv = ellipse(cov, sigmas)
    if not (
        math.isfinite(uu) and math.isfinite(vv) and math.isfinite(centre[0]) and math.isfinite(centre[1])
    ):
        return (0, -1), (0, -1)
    across, down = min(sigmas * math.sqrt(uu), most), min(sigmas * math.sqrt(vv), most)
    columns = _clipped(centre[0], across, half, shape[1] - 1 - half)
    return columns, _clipped(centre[1], down, half, shape[0] - 1 - half)


@njit(cache=True, error_model="numpy")
def _clipped(centre, reach, first, last):
    """Whole numbers within reach of the centre and in first..last."""
    if centre + reach < first or centre - reach > last:
        return 0, -1
    return int(max(np.ceil(centre - reach), first)), int(min(np.floor(centre + reach), last))


@njit(cache=True, error_model="numpy")
def best(scores):
    """Row and column of the highest score, the first of equal ones."""
    row, column, highest = 0, 0, scores[0, 0]
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            if scores[y, x] > highest:
                row, column, highest = y, x, scores[y, x]
    return row, column


@njit(cache=True, error_model="numpy")
def second(scores, row, column):
    """Row and column of the highest peak elsewhere, −1 where there is none."""
    height, width = scores.shape
    v, u, highest = -1, -1, np.float32(-1.0)
    for y in range(height):
        for x in range(width):
            apart = max(abs(y - row), abs(x - column)) >= APART_PX
            if scores[y, x] > highest and apart and _is_peak(scores, y, x):
                v, u, highest = y, x, scores[y, x]
    return v, u


@njit(cache=True, error_model="numpy")
def _is_peak(scores, row, column):
    """Whether no searched neighbour scores higher."""
    for y in range(max(row - 1, 0), min(row + 2, scores.shape[0])):
        for x in range(max(column - 1, 0), min(column + 2, scores.shape[1])):
            if scores[y, x] > scores[row, column]:
                return False
    return True
