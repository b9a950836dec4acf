"""Matching of two sets of descriptors: distance limit, ratio test and mutual nearest neighbours.

Descriptors are float32 rows of length 1, so that one matrix product gives all distances: |a − b|² = 2 − 2 aᵀb. Where pixels
or a prediction restrict the candidate pairs (`band_pairs`, `gate_pairs`), only those are compared (`match_pairs`) and take
part in the ratio test.

A map's descriptors are stored once for all particles and matched with those of new images (S05 §III-B, §V): with all of
them by one matrix product, or only with those of the landmarks predicted nearby.
"""

from dataclasses import dataclass
from typing import Annotated, final

import numpy as np

from rbpf.arrays import RowByRow
from rbpf.core.likelihoods import squared_mahalanobis
from rbpf.ranges import Range, Ranged

BLOCK = 4096  #: Columns of a product computed per block: a block of a few hundred rows fits the cache.
#: Largest distance of matching "root" descriptors, by their length: it separates most true from most false pairs.
LARGEST = {36: 0.25, 128: 0.55}
#: Cost of comparing a single pair relative to one in a matrix product; and pairs gathered at a time.
GATHERED, PAIRS = 8, 65536


@dataclass(frozen=True)
class MatchLimits(Ranged):
    """Limits for accepting a match."""

    #: the largest distance of two descriptors, at most 2; None for `LARGEST` of their length.
    distance: Annotated[float | None, Range(gt=0.0, le=2.0)] = None
    #: largest ratio of the distance to that of the second-best candidate (D. Lowe 2004, §7.1); 1 is no limit.
    ratio: Annotated[float, Range(gt=0.0, le=1.0)] = 0.8
    mutual: bool = True  #: whether both have to be mutual nearest neighbours.

    def largest(self, length: int) -> float:
        """Largest accepted distance of descriptors of this length."""
        return LARGEST.get(length, 2.0) if self.distance is None else self.distance


@final
@dataclass(frozen=True)
class DescriptorMatches(RowByRow):
    """Pairs of descriptors, each at most once on either side, in the order of the first set."""

    first: np.ndarray  #: (P,) rows of the first set.
    second: np.ndarray  #: (P,) rows of the second set.
    distance: np.ndarray  #: (P,) of the descriptors.


def match_all(first: np.ndarray, second: np.ndarray, limits: MatchLimits) -> DescriptorMatches:
    """Matches descriptors (K, d) with descriptors (M, d); all pairs are candidates."""
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
    """Matches descriptors (K, d) with descriptors (M, d) among candidate pairs (C,), (C,) of their rows, each pair once."""
    k, m = pairs
    if not k.size:
        return one_each(k, m, np.zeros(0))
    # By one matrix product if there are many pairs, else pair by pair.
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
    """Mask (K,): products with the best and the next best candidate pass distance and ratio test; −inf: no candidate."""
    distance, other = distances(best), distances(next_best)
    # Two equal candidates at distance 0 are ambiguous, too.
    near = distance <= limits.largest(length)
    return near & ((distance < limits.ratio * other) | (limits.ratio == 1.0))


def distances(products: np.ndarray) -> np.ndarray:
    """Distances of descriptors of length 1, from their products."""
    return np.sqrt(np.maximum(2.0 - 2.0 * products.astype(np.float64), 0.0))


def one_each(first: np.ndarray, second: np.ndarray, products: np.ndarray) -> DescriptorMatches:
    """Of pairs (P,), (P,) with the same row of the second set, keeps the nearest; of ties the first."""
    matches = DescriptorMatches(first, second, distances(products))
    order = np.lexsort((matches.distance, matches.second))
    return matches.take(np.sort(_first_of(matches.second, order)))


def _first_of(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The rows at which a value occurs first."""
    _, first = np.unique(values[rows], return_index=True)
    return np.asarray(rows[first])


def band_pairs(first: np.ndarray, second: np.ndarray, reach: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Indices (C,), (C,) of all pairs of values (K,) and (M,) that differ by at most `reach` (K,) or ()."""
    order = np.argsort(second, kind="stable")
    low = np.searchsorted(second[order], first - reach, side="left")
    count = np.maximum(np.searchsorted(second[order], first + reach, side="right") - low, 0)
    k = np.repeat(np.arange(first.size), count)
    offset = np.arange(k.size) - np.repeat(np.cumsum(count) - count, count)
    return k, order[np.repeat(low, count) + offset]


def gate_pairs(
    z: np.ndarray, noise: np.ndarray, mean: np.ndarray, cov: np.ndarray, gate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (C,) of measurements z (K, p) and (C,) of predictions (M, p) that pass a gate.

    `gate` is the largest squared Mahalanobis distance; cov (M, p, p) excludes the measurement noise (K, p, p).
    Predictions that are not finite pass no gate.
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
