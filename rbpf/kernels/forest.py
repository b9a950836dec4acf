"""The forest of ancestors: one node per particle and generation, dead branches freed as soon as they die.

A node is a row of four numbers, contiguous as all are needed together: PARENT (-1 at a root), CHILDREN (number of
children, plus one for a current particle), GENERATION and ROW (the particle's index within its generation).
P. Jacob, L. Murray, S. Rubenthaler, "Path storage in the particle filter" (2015), give the expected size, T + C·N log N nodes.
"""

import numpy as np
from numba import boolean, int64, njit, types

from rbpf.kernels.signature import INDEX_MATRIX, INDICES

PARENT, CHILDREN, GENERATION, ROW = range(4)
# Compiled on import, as the other drivers: the first bounded history need not wait for it.
_FLAGS = types.Array(boolean, 1, "C")


@njit(int64(INDEX_MATRIX, INDICES, int64, INDICES, INDICES, int64), cache=True)
def advance(nodes, free, n_free, leaves, ancestors, now):
    """Adds a node for each descendant and frees lineages without descendants; returns the free-list's length."""
    n = leaves.size
    fresh = np.empty(n, np.int64)
    for i in range(n):
        n_free -= 1
        node, above = free[n_free], leaves[ancestors[i]]
        fresh[i] = node
        nodes[above, CHILDREN] += 1
        nodes[node, PARENT], nodes[node, CHILDREN] = above, 1
        nodes[node, GENERATION], nodes[node, ROW] = now, i
    for i in range(n):
        node = leaves[i]
        nodes[node, CHILDREN] -= 1
        while node >= 0 and nodes[node, CHILDREN] == 0:
            free[n_free] = node
            n_free += 1
            nodes[node, GENERATION] = -1
            node = nodes[node, PARENT]
            if node >= 0:
                nodes[node, CHILDREN] -= 1
    for i in range(n):
        leaves[i] = fresh[i]
    return n_free


@njit(INDICES(INDEX_MATRIX, INDICES, int64, INDICES, INDICES, int64), cache=True)
def rows_at(nodes, leaves, wanted, found, stamp, mark):
    """Row of each particle's ancestor in generation `wanted`; each node on the way is visited once.

    `found` and `stamp` are scratch arrays of the forest's size; `mark` is a number that is not in `stamp` yet.
    """
    out = np.empty(leaves.size, np.int64)
    for i in range(leaves.size):
        node = leaves[i]
        while nodes[node, GENERATION] > wanted and stamp[node] != mark:
            node = nodes[node, PARENT]
        out[i] = found[node] if stamp[node] == mark else nodes[node, ROW]
        node = leaves[i]
        while nodes[node, GENERATION] > wanted and stamp[node] != mark:
            found[node] = out[i]
            stamp[node] = mark
            node = nodes[node, PARENT]
    return out


@njit(types.UniTuple(INDICES, 2)(INDEX_MATRIX, INDICES, int64), cache=True)
def survivors(nodes, members, wanted):
    """The surviving nodes of generation `wanted` among its `members`, and their rows."""
    held, rows, count = np.empty(members.size, np.int64), np.empty(members.size, np.int64), 0
    for node in members:
        if nodes[node, GENERATION] == wanted:
            held[count], rows[count] = node, nodes[node, ROW]
            count += 1
    return held[:count].copy(), rows[:count].copy()


@njit(int64(INDEX_MATRIX, INDICES, int64, INDICES, _FLAGS, INDICES, int64), cache=True)
def splice(nodes, free, n_free, leaves, needed, stamp, mark):
    """Removes nodes with one child that are not needed themselves; returns the free-list's length."""
    for i in range(leaves.size):
        node = leaves[i]
        while node >= 0 and stamp[node] != mark:
            stamp[node] = mark
            above = nodes[node, PARENT]
            while above >= 0 and nodes[above, CHILDREN] == 1 and not needed[above]:
                free[n_free] = above
                n_free += 1
                nodes[above, GENERATION] = -1
                above = nodes[above, PARENT]
            nodes[node, PARENT] = above
            node = above
    return n_free
