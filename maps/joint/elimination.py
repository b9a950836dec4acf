"""Multifrontal Cholesky elimination of a symmetric positive definite sum of dense blocks (I. Duff and J. Reid 1983).

Columns that occur in the same blocks of the sum are eliminated together, those with the fewest neighbours first. The
elimination tree consists of *cliques*: eliminated columns, and the later columns coupled to them.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from rbpf.kernels.dense import add_principal


class Clique(NamedTuple):
    """Eliminated columns (o,), later ones coupled to them (s,), blocks that are added here, the parent clique or -1."""

    own: np.ndarray
    behind: np.ndarray
    blocks: list[int]
    parent: int


def cliques_of(size: int, blocks: list[np.ndarray]) -> list[Clique]:
    """The elimination order of columns (size,); each block (b,) lists distinct columns.

    Memory is the square of the number of groups of columns that are in the same blocks, a byte for each pair.
    """
    group, count = np.zeros(size, dtype=np.int64), 1
    for block in blocks:
        names, which = np.unique(group[block], return_inverse=True)
        group[block], count = count + which, count + names.size
    _, group, sizes = np.unique(group, return_inverse=True, return_counts=True)
    groups = [np.unique(group[block]) for block in blocks]
    touches = np.eye(sizes.size, dtype=bool)
    for own in groups:
        touches[np.ix_(own, own)] = True
    degree = np.array([sizes[row].sum() for row in touches])
    clique_of, eliminated = np.zeros(sizes.size, dtype=np.int64), list[tuple[np.ndarray, np.ndarray]]()
    while degree.min() <= size:
        every = np.flatnonzero(touches[degree.argmin()])
        touches[np.ix_(every, every)] = True
        degree[every] = touches[every] @ sizes
        # Columns coupled to no others are eliminated at the same time.
        now = degree[every] == sizes[every].sum()
        own, behind = every[now], every[~now]
        touches[np.ix_(behind, own)] = False
        clique_of[own] = len(eliminated)
        degree[behind] -= sizes[own].sum()
        degree[own] = size + 1
        eliminated.append((own, behind))
    begins: list[list[int]] = [[] for _ in eliminated]
    for number, own in enumerate(groups):
        if own.size:
            begins[clique_of[own].min()].append(number)
    columns = np.split(np.argsort(group, kind="stable"), np.cumsum(sizes)[:-1])
    none = np.zeros(0, dtype=np.int64)
    return [
        Clique(
            np.concatenate([columns[each] for each in own]), np.concatenate([none, *(columns[each] for each in behind)]),
            begun, int(clique_of[behind].min()) if behind.size else -1,
        )
        for (own, behind), begun in zip(eliminated, begins, strict=True)
    ]  # fmt: skip


class Elimination:
    """The Cholesky factor of a sum of matrices (b, b), each in the columns of its block. Raises LinAlgError: it has none."""

    def __init__(self, size: int, blocks: list[np.ndarray], cliques: list[Clique], summands: list[np.ndarray]) -> None:
        self.size, self.blocks, self.cliques = size, blocks, cliques
        self.factors = list[tuple[np.ndarray, np.ndarray]]()  # of each clique L (o, o), L⁻¹ times its coupling (o, s)
        waiting: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in cliques]
        place = np.zeros(size, dtype=np.int64)
        for clique, theirs in zip(cliques, waiting, strict=True):
            o, every = clique.own.size, np.append(clique.own, clique.behind)
            place[every] = np.arange(every.size)
            front = np.zeros((every.size, every.size))
            for columns, summand in [(blocks[block], summands[block]) for block in clique.blocks] + theirs:
                add_principal(front, place[columns], summand)
            theirs.clear()
            lower = cholesky(front[:o, :o], lower=True, check_finite=False)
            if not np.isfinite(np.diagonal(lower)).all():
                raise LinAlgError("not finite")
            across = solve_triangular(lower, front[:o, o:], lower=True, check_finite=False)
            self.factors.append((lower, across))
            if clique.parent >= 0:
                waiting[clique.parent].append((clique.behind, front[o:, o:] - across.T @ across))

    def _forward(self, right: np.ndarray) -> np.ndarray:
        """L⁻¹ of (size, k), in place; cliques with a zero right-hand side are skipped."""
        for clique, (lower, across) in zip(self.cliques, self.factors, strict=True):
            if right[clique.own].any():
                right[clique.own] = own = solve_triangular(lower, right[clique.own], lower=True, check_finite=False)
                right[clique.behind] -= across.T @ own
        return right

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (size,) of the linear system."""
        out = self._forward(right.copy())
        for clique, (lower, across) in zip(self.cliques[::-1], self.factors[::-1], strict=True):
            rest = out[clique.own] - across @ out[clique.behind]
            out[clique.own] = solve_triangular(lower, rest, lower=True, trans="T", check_finite=False)
        return out

    def marginal(self, columns: np.ndarray) -> np.ndarray:
        """The block (c, c) of the inverse for some columns."""
        unit = np.zeros((self.size, columns.size))
        unit[columns, np.arange(columns.size)] = 1.0
        half = self._forward(unit)
        return np.asarray(half.T @ half)

    def within(self) -> list[np.ndarray]:
        """The inverse within each block (b, b), backwards from the last clique (K. Takahashi, J. Fagan and M. Chin 1973)."""
        out, held = [np.zeros((0, 0))] * len(self.blocks), [np.zeros((0, 0))] * len(self.cliques)
        place = np.zeros(self.size, dtype=np.int64)
        for number in range(len(self.cliques) - 1, -1, -1):
            clique, (lower, across) = self.cliques[number], self.factors[number]
            half = solve_triangular(lower, np.eye(len(lower)), lower=True, check_finite=False)
            inverse = half.T @ half
            if clique.parent >= 0:
                above = self.cliques[clique.parent]
                place[np.append(above.own, above.behind)] = np.arange(len(held[clique.parent]))
                behind = held[clique.parent][np.ix_(place[clique.behind], place[clique.behind])]
                slope = half.T @ across
                cross = -slope @ behind
                inverse = np.block([[inverse - cross @ slope.T, cross], [cross.T, behind]])
            held[number], place[np.append(clique.own, clique.behind)] = inverse, np.arange(len(inverse))
            for block in clique.blocks:
                out[block] = inverse[np.ix_(place[self.blocks[block]], place[self.blocks[block]])]
        return out
