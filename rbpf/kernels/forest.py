"""The forest of ancestors: one node per particle and generation, dead branches freed as soon as they die.

Nodes live in flat arrays: `parent` (-1 at a root), `children` (number of children, plus one for a current particle),
`generation` and `row` (the particle's index within its generation). P. Jacob, L. Murray, S. Rubenthaler, "Path
storage in the particle filter" (2015), give the expected size, T + C·N log N nodes.
"""

import numpy as np
from numba import boolean, int64, njit, types

from rbpf.kernels.signature import INDICES

# Compiled as they are loaded, as the other drivers: the first history that is bounded need not wait for it.
_NODES = (INDICES,) * 4
_FLAGS = types.Array(boolean, 1, "C")


@njit(int64(*_NODES, INDICES, int64, INDICES, INDICES, int64), cache=True)
def advance(parent, children, generation, row, free, n_free, leaves, ancestors, now):
    """Makes a node for each descendant and frees the lineages without one; returns the free-list's length."""
    n = leaves.size
    fresh = np.empty(n, np.int64)
    for i in range(n):
        n_free -= 1
        node = free[n_free]
        fresh[i] = node
        parent[node] = leaves[ancestors[i]]
        children[node] = 1
        children[parent[node]] += 1
        generation[node] = now
        row[node] = i
    for i in range(n):
        node = leaves[i]
        children[node] -= 1
        while node >= 0 and children[node] == 0:
            free[n_free] = node
            n_free += 1
            generation[node] = -1
            node = parent[node]
            if node >= 0:
                children[node] -= 1
    leaves[:] = fresh
    return n_free


@njit(INDICES(INDICES, INDICES, INDICES, INDICES, int64, INDICES, INDICES, int64), cache=True)
def rows_at(parent, generation, row, leaves, wanted, found, stamp, mark):
    """Row of each particle's ancestor in generation `wanted`; each node of the way is climbed once.

    `found` and `stamp` are scratch of the forest's size; `mark` is a number that `stamp` does not hold yet.
    """
    out = np.empty(leaves.size, np.int64)
    for i in range(leaves.size):
        node = leaves[i]
        while generation[node] > wanted and stamp[node] != mark:
            node = parent[node]
        out[i] = found[node] if stamp[node] == mark else row[node]
        node = leaves[i]
        while generation[node] > wanted and stamp[node] != mark:
            found[node] = out[i]
            stamp[node] = mark
            node = parent[node]
    return out


@njit(int64(INDICES, INDICES, INDICES, INDICES, int64, INDICES, _FLAGS, INDICES, int64), cache=True)
def splice(parent, children, generation, free, n_free, leaves, needed, stamp, mark):
    """Removes nodes with a single child that are not needed themselves; returns the free-list's length."""
    for i in range(leaves.size):
        node = leaves[i]
        while node >= 0 and stamp[node] != mark:
            stamp[node] = mark
            above = parent[node]
            while above >= 0 and children[above] == 1 and not needed[above]:
                free[n_free] = above
                n_free += 1
                generation[above] = -1
                above = parent[above]
            parent[node] = above
            node = above
    return n_free
