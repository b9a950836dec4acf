"""Which descriptors of two sets match: distance, ratio to the next best, and preference on both sides.

Descriptors are float32 rows of length 1, so that one matrix product gives all distances: |a − b|² = 2 − 2 aᵀb. Where
pixels or a prediction leave few candidate pairs (`band_pairs`, `gate_pairs`), only those are compared (`match_pairs`),
and only those compete in the ratio test.

The descriptors of a map are stored once for all particles, and found again in new images (S05 §III-B, §V): compared with all
by one matrix product, or one by one with those of the landmarks that a prediction puts near.
"""

from dataclasses import dataclass
from typing import Annotated, final

import numpy as np

from rbpf.arrays import RowByRow
from rbpf.core.likelihoods import squared_mahalanobis
from rbpf.ranges import Range, Ranged

BLOCK = 4096  #: Columns of a product that are looked at together: a block of a few hundred rows stays in the cache.
#: Distances of "root" descriptors by their length: few of one place are further apart, and few of two places nearer.
LARGEST = {36: 0.25, 128: 0.55}
#: Comparing a pair on its own costs as much as so many of a matrix product; pairs gathered at a time.
GATHERED, PAIRS = 8, 65536


@dataclass(frozen=True)
class MatchLimits(Ranged):
    """When a candidate is taken."""

    #: the largest distance of two descriptors, at most 2; None for `LARGEST` of their length.
    distance: Annotated[float | None, Range(gt=0.0, le=2.0)] = None
    #: largest ratio of the distance to that of the second-best candidate (D. Lowe 2004, §7.1); 1 is no limit.
    ratio: Annotated[float, Range(gt=0.0, le=1.0)] = 0.8
    mutual: bool = True  #: whether each has to be the other's nearest.

    def largest(self, length: int) -> float:
        """Distance up to which descriptors of this length are taken."""
        return LARGEST.get(length, 2.0) if self.distance is None else self.distance


@final
@dataclass(frozen=True)
class DescriptorMatches(RowByRow):
    """Pairs of descriptors, each at most once on either side, in the order of the first set."""

    first: np.ndarray  #: (P,) rows of the first set.
    second: np.ndarray  #: (P,) rows of the second set.
    distance: np.ndarray  #: (P,) of the descriptors.


def match_all(first: np.ndarray, second: np.ndarray, limits: MatchLimits) -> DescriptorMatches:
    """Matches descriptors (K, d) with descriptors (M, d), every one of which is a candidate."""
    product, next_best, where = two_best(first, second)
    kept = np.flatnonzero(within(product, next_best, limits, first.shape[1]))
    if limits.mutual and kept.size:
        preferred = (first @ second[where[kept]].T).argmax(axis=0)
        kept = kept[preferred == kept]
    return one_each(kept, where[kept], product[kept])


def two_best(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each descriptor (K, d) the two best of others (M, d), by a matrix product in blocks of M.

    Returns:
        Products (K,) with the best and with the next one, −inf where there is none, and the best one's row (K,).
    """
    rows = np.arange(first.shape[0])
    best, next_best = np.full((2, rows.size), -np.inf, dtype=np.float32)
    where = np.zeros(rows.size, dtype=np.int64)
    for start in range(0, second.shape[0], BLOCK):
        products = first @ second[start : start + BLOCK].T
        column = products.argmax(axis=1)
        top = products[rows, column]
        products[rows, column] = -np.inf
        next_best = np.maximum(np.maximum(next_best, products.max(axis=1)), np.minimum(top, best))
        better = top > best
        best, where = np.where(better, top, best), np.where(better, start + column, where)
    return best, next_best, where


def match_pairs(
    first: np.ndarray, second: np.ndarray, pairs: tuple[np.ndarray, np.ndarray], limits: MatchLimits
) -> DescriptorMatches:
    """Matches descriptors (K, d) with descriptors (M, d) where only pairs (C,), (C,) of their rows are possible, each once."""
    k, m = pairs
    if not k.size:
        return one_each(k, m, np.zeros(0))
    # All at once by a matrix product where the pairs are many, else one by one.
    if k.size * GATHERED > first.shape[0] * second.shape[0]:
        products = (first @ second.T)[k, m]
    else:
        parts = [slice(start, start + PAIRS) for start in range(0, k.size, PAIRS)]
        products = np.concatenate([np.einsum("cd,cd->c", first[k[part]], second[m[part]]) for part in parts])
    best = np.full(first.shape[0], -np.inf, dtype=np.float32)
    np.maximum.at(best, k, products)
    top = _first_of(k, np.flatnonzero(products == best[k]))
    others, next_best = np.delete(np.arange(k.size), top), np.full_like(best, -np.inf)
    np.maximum.at(next_best, k[others], products[others])
    top = top[within(products[top], next_best[k[top]], limits, first.shape[1])]
    if limits.mutual:
        wanted = np.full(second.shape[0], -np.inf, dtype=np.float32)
        np.maximum.at(wanted, m, products)
        top = top[products[top] == wanted[m[top]]]
    return one_each(k[top], m[top], products[top])


def within(best: np.ndarray, next_best: np.ndarray, limits: MatchLimits, length: int) -> np.ndarray:
    """Whether products (K,) of the best and of the next best candidates pass distance and ratio; −inf is none."""
    distance, other = distances(best), distances(next_best)
    # Two equal candidates at distance 0 are ambiguous, too.
    near = distance <= limits.largest(length)
    return near & ((distance < limits.ratio * other) | (limits.ratio == 1.0))


def distances(products: np.ndarray) -> np.ndarray:
    """Of descriptors of length 1, from their products."""
    return np.sqrt(np.maximum(2.0 - 2.0 * products.astype(np.float64), 0.0))


def one_each(first: np.ndarray, second: np.ndarray, products: np.ndarray) -> DescriptorMatches:
    """Of pairs (P,), (P,) that share a row of the second set the nearest, of equally near ones the first."""
    matches = DescriptorMatches(first, second, distances(products))
    order = np.lexsort((matches.distance, matches.second))
    return matches.take(np.sort(_first_of(matches.second, order)))


def _first_of(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Of the rows those at which a value occurs first."""
    _, first = np.unique(values[rows], return_index=True)
    return np.asarray(rows[first])


def band_pairs(first: np.ndarray, second: np.ndarray, reach: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """All pairs (C,), (C,) of numbers (K,) and (M,) that differ by at most the reach (K,) or ()."""
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - reach, side="left")
    count = np.maximum(np.searchsorted(second[order], first + reach, side="right") - low, 0)
    k = np.repeat(np.arange(first.size), count)
    offset = np.arange(k.size) - np.repeat(np.cumsum(count) - count, count)
    return k, order[np.repeat(low, count) + offset]


def gate_pairs(
    z: np.ndarray, noise: np.ndarray, mean: np.ndarray, cov: np.ndarray, gate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (C,) of measurements z (K, p) and (C,) of predictions (M, p) that are near to one another.

    `gate` is the largest squared Mahalanobis distance; cov (M, p, p) is without the measurements' noise (K, p, p).
    Predictions that are not finite are near to nothing.
    """
    held = np.flatnonzero(np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    mean, cov = mean[held], cov[held]
    widest = np.diagonal(noise, axis1=1, axis2=2).max(axis=0, initial=0.0)
    reach = np.sqrt(gate * (np.diagonal(cov, axis1=1, axis2=2) + widest))
    m, k = band_pairs(mean[:, 0], z[:, 0], reach[:, 0])
    for axis in range(1, z.shape[1]):
        near = np.abs(z[k, axis] - mean[m, axis]) <= reach[m, axis]
        k, m = k[near], m[near]
    near = squared_mahalanobis(z[k] - mean[m], noise[k] + cov[m]) <= gate
    return k[near], held[m[near]]
