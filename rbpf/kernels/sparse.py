"""What is sparse and symmetric: the entries of its inverse that its factor has a place for."""

import numpy as np
from numba import njit

from rbpf.kernels.signature import INDICES, VECTOR


def filled(starts: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the Cholesky factor of a symmetric matrix (n, n) may have entries, by where its lower triangle has.

    Args:
        starts: (n + 1,) where each column begins in rows.
        rows: of the entries, the diagonal first and then in order.

    Returns:
        The same of the factor.
    """
    columns = np.split(rows, starts[1:-1])
    for own in columns:
        if own.size > 2:
            columns[own[1]] = np.union1d(columns[own[1]], own[1:])
    return np.append(0, np.cumsum([own.size for own in columns])), np.concatenate(columns).astype(np.int64)


@njit(VECTOR(INDICES, INDICES, VECTOR, VECTOR), cache=True, error_model="numpy")
def selected_inverse(starts, rows, lower, pivots):
    """Entries of (L D Lᵀ)⁻¹ at the places of `filled` (K. Takahashi, J. Fagan and M. Chin 1973).

    `lower` are those of L, whose diagonal is 1, and `pivots` D. The work is that of the factor.
    """
    out = np.zeros(lower.size)
    for j in range(starts.size - 2, -1, -1):
        begin, end = starts[j], starts[j + 1]
        # Z_Sj = −Z_SS L_Sj for the rows S below the diagonal, all pairs of which have a place.
        for a in range(begin + 1, end):
            place = starts[rows[a]]
            out[a] -= out[place] * lower[a]
            for b in range(a + 1, end):
                while rows[place] != rows[b]:
                    place += 1
                out[b] -= out[place] * lower[a]
                out[a] -= out[place] * lower[b]
        rest = 1.0 / pivots[j]
        for a in range(begin + 1, end):
            rest -= lower[a] * out[a]
        out[begin] = rest
    return out
