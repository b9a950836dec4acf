"""Dense linear algebra: Cholesky factors of small matrices, solves, products, and updates that preserve symmetry."""

import math

import numpy as np
from numba import float64, int64, njit, void

from rbpf.kernels.signature import BLOCK, CUBE, INDEX_MATRIX, INDICES, MATRIX, VECTOR, in_parts


@njit(cache=True, error_model="numpy")
def factor(matrix, least=0.0):
    """Replaces the lower triangle of a positive definite matrix by its Cholesky factor.

    Returns whether it is definite: every pivot is above the fraction `least` of its variance.
    """
    definite = True
    for a in range(matrix.shape[0]):
        for b in range(a + 1):
            rest = matrix[a, b]
            for c in range(b):
                rest -= matrix[a, c] * matrix[b, c]
            if a == b:
                definite = definite and rest > least * matrix[a, a]
            matrix[a, b] = math.sqrt(rest) if a == b else rest / matrix[b, b]
    return definite


@njit(cache=True, error_model="numpy")
def solve_lower(chol, vector):
    """Replaces a vector by L⁻¹ times it."""
    for a in range(vector.size):
        for b in range(a):
            vector[a] -= chol[a, b] * vector[b]
        vector[a] /= chol[a, a]


@njit(cache=True, error_model="numpy")
def solve(chol, vector):
    """Replaces a vector by (L Lᵀ)⁻¹ times it."""
    solve_lower(chol, vector)
    for a in range(vector.size - 1, -1, -1):
        for b in range(a + 1, vector.size):
            vector[a] -= chol[b, a] * vector[b]
        vector[a] /= chol[a, a]


@njit(void(MATRIX, CUBE, int64, float64, VECTOR, MATRIX), cache=True, error_model="numpy")
def fit_robustly(white, slope, rounds, scale, u, info):
    """Fills u (r,), of standard normal prior, from residuals (K, p) and Jacobians (K, p, r), and its information (r, r).

    Iteratively reweighted least squares with a Cauchy loss; a residual as large as `scale` keeps half of its weight.
    """
    (count, p, rank), total = slope.shape, np.empty(u.size)
    off = np.empty(p)
    u[:] = 0.0
    for _ in range(rounds):
        info[:] = total[:] = 0.0
        for r in range(rank):
            info[r, r] = 1.0
        for k in range(count):
            squared = 0.0
            for a in range(p):
                off[a] = white[k, a]
                for r in range(rank):
                    off[a] -= slope[k, a, r] * u[r]
                squared += off[a] * off[a]
            weight = 1.0 / (1.0 + squared / (scale * scale))
            for a in range(p):
                for r in range(rank):
                    weighed = weight * slope[k, a, r]
                    total[r] += weighed * white[k, a]
                    for s in range(rank):
                        info[r, s] += weighed * slope[k, a, s]
        chol = info.copy()
        factor(chol)
        solve(chol, total)
        for r in range(rank):
            u[r] = total[r]


@njit(void(MATRIX, CUBE, MATRIX, MATRIX), cache=True, error_model="numpy")
def increments(mean, factor, u, out):
    """Fills ε = μ + L u (N, d), of μ (N or 1, d), L (N or 1, d, r) and u (N or 1, r).

    Even and odd terms are summed separately, as in `numpy.einsum`.
    """
    rank = u.shape[1]
    for i in range(len(out)):
        own_mean, own_factor, own = i if len(mean) > 1 else 0, i if len(factor) > 1 else 0, i if len(u) > 1 else 0
        for a in range(out.shape[1]):
            even = odd = 0.0
            for r in range(0, rank - 1, 2):
                even += factor[own_factor, a, r] * u[own, r]
                odd += factor[own_factor, a, r + 1] * u[own, r + 1]
            if rank % 2:
                even += factor[own_factor, a, rank - 1] * u[own, rank - 1]
            out[i, a] = mean[own_mean, a] + (even + odd)


@njit(void(CUBE, CUBE, VECTOR, VECTOR), cache=True, error_model="numpy")
def log_densities(nu, chol, log_det, out):
    """Adds Σ log N(ν; 0, S) to `out` (N,), for innovations (N, K, p), with L (K, p, p) of S = L Lᵀ and log|S| (K,)."""
    white, constant = np.empty(nu.shape[2]), nu.shape[2] * math.log(2.0 * math.pi)
    for i in range(len(nu)):
        for k in range(len(chol)):
            squared = 0.0
            for a in range(white.size):
                rest = nu[i, k, a]
                for b in range(a):
                    rest -= chol[k, a, b] * white[b]
                white[a] = rest / chol[k, a, a]
                squared += white[a] * white[a]
            out[i] -= 0.5 * (squared + log_det[k] + constant)


@njit(void(VECTOR, float64, INDICES), cache=True, error_model="numpy")
def comb(weights, offset, ancestors):
    """Fills the ancestors (N,), ascending, selected by a comb with teeth at k + `offset`, see `rbpf.core.resampling`."""
    n, last, total = weights.size, 0, 0.0
    for i in range(n):
        total += weights[i]
        if weights[i] != 0.0:
            last = i
    tooth, scale, total = 0, n / total, 0.0
    for i in range(last):
        total += weights[i]
        end = min(math.ceil(total * scale - offset), n)
        while tooth < end:
            ancestors[tooth] = i
            tooth += 1
    ancestors[tooth:] = last


@in_parts(CUBE, MATRIX, CUBE, MATRIX, CUBE, VECTOR, VECTOR)
def refine(block, arguments):
    """Fills mean (N, r) and root (N, r, r) of u, |C⁻¹Lᵀη|² and log |M| (N,), see `rbpf.core.proposals`.

    For N particles with Λ (N, d, d) and η (N, d), and L (N or 1, d, r). If M is not definite, all outputs are NaN. Parts
    are blocks of particles, along which the innermost loops run.
    """
    info, vector, root_prior, mean, root, squared, log_det = arguments
    dim, rank = root_prior.shape[1], root_prior.shape[2]
    spread, half = np.empty((dim, rank, BLOCK)), np.empty((rank, BLOCK))
    chol, inverse = np.empty((rank, rank, BLOCK)), np.empty((rank, rank, BLOCK))
    white, lane = np.empty((rank, BLOCK)), np.empty(BLOCK)
    start = block * BLOCK
    count = min(BLOCK, len(info) - start)
    for a in range(dim):
        for r in range(rank):
            for i in range(count):
                spread[a, r, i] = root_prior[start + i if len(root_prior) > 1 else 0, a, r]
    for r in range(rank):
        white[r] = 0.0
        for s in range(r + 1):
            chol[r, s] = 1.0 if r == s else 0.0
    # C of M = I + Lᵀ Λ L, row by row of Λ, and Lᵀη.
    for a in range(dim):
        half[:] = 0.0
        for b in range(dim):
            for i in range(count):
                lane[i] = info[start + i, a, b]
            for r in range(rank):
                for i in range(count):
                    half[r, i] += lane[i] * spread[b, r, i]
        for i in range(count):
            lane[i] = vector[start + i, a]
        for r in range(rank):
            for i in range(count):
                white[r, i] += spread[a, r, i] * lane[i]
            for s in range(r + 1):
                for i in range(count):
                    chol[r, s, i] += spread[a, r, i] * half[s, i]
    for r in range(rank):
        for s in range(r + 1):
            for c in range(s):
                for i in range(count):
                    chol[r, s, i] -= chol[r, c, i] * chol[s, c, i]
            for i in range(count):
                chol[r, s, i] = math.sqrt(chol[r, s, i]) if r == s else chol[r, s, i] / chol[s, s, i]
    for r in range(rank):
        for c in range(r):
            for i in range(count):
                white[r, i] -= chol[r, c, i] * white[c, i]
        for i in range(count):
            white[r, i] /= chol[r, r, i]
    # Columns of C⁻¹, the rows of its transpose: zero before the diagonal.
    for r in range(rank):
        for a in range(rank):
            inverse[r, a] = 0.0
        for i in range(count):
            inverse[r, r, i] = 1.0 / chol[r, r, i]
        for a in range(r + 1, rank):
            for c in range(r, a):
                for i in range(count):
                    inverse[r, a, i] -= chol[a, c, i] * inverse[r, c, i]
            for i in range(count):
                inverse[r, a, i] /= chol[a, a, i]
    squared[start : start + count] = log_det[start : start + count] = 0.0
    for r in range(rank):
        lane[:] = 0.0
        for c in range(r, rank):
            for i in range(count):
                lane[i] += inverse[r, c, i] * white[c, i]
        for i in range(count):
            mean[start + i, r] = lane[i]
            squared[start + i] += white[r, i] * white[r, i]
            log_det[start + i] += 2.0 * math.log(chol[r, r, i])
            for c in range(rank):
                root[start + i, r, c] = inverse[r, c, i]


@njit(void(CUBE, MATRIX, CUBE, MATRIX, VECTOR), cache=True, error_model="numpy")
def chart(jacobian, offset, info, vector, quad):
    """Replaces Λ (N, d, d), η (N, d) and νᵀS⁻¹ν (N,) by those in another chart, see `rbpf.core.particles.Information`."""
    dim = info.shape[1]
    half, moved = np.empty((dim, dim)), np.empty(dim)
    for i in range(len(info)):
        turn, apart = jacobian[i if len(jacobian) > 1 else 0], offset[i if len(offset) > 1 else 0]
        for a in range(dim):
            moved[a] = 0.0
            for b in range(dim):
                moved[a] += turn[b, a] * vector[i, b]
                half[a, b] = 0.0
                for c in range(dim):
                    half[a, b] += info[i, a, c] * turn[c, b]
        for a in range(dim):
            vector[i, a] = moved[a]
            for b in range(dim):
                info[i, a, b] = 0.0
                for c in range(dim):
                    info[i, a, b] += turn[c, a] * half[c, b]
                moved[a] += info[i, a, b] * apart[b]
            quad[i] += apart[a] * (vector[i, a] + moved[a])
            vector[i, a] = moved[a]


@njit(cache=True, error_model="numpy")
def product(left, right):
    """(m, k) times (k, n), C-contiguous: the same bytes on any number of threads, which BLAS does not guarantee."""
    m, count = left.shape
    out = np.zeros((m, right.shape[1]))
    whole = count - count % 4
    for k in range(0, whole, 4):  # four rows of the right matrix stay in the cache
        for i in range(m):
            a, b, c, d = left[i, k], left[i, k + 1], left[i, k + 2], left[i, k + 3]
            for j in range(right.shape[1]):
                out[i, j] += (a * right[k, j] + b * right[k + 1, j]) + (c * right[k + 2, j] + d * right[k + 3, j])
    for k in range(whole, count):
        for i in range(m):
            for j in range(right.shape[1]):
                out[i, j] += left[i, k] * right[k, j]
    return out


@njit(cache=True, error_model="numpy")
def add_principal(matrix, rows, part):
    """Adds a part (k, k) to the principal submatrix of distinct rows (k,)."""
    for i in range(rows.size):
        row = matrix[rows[i]]
        for j in range(rows.size):
            row[rows[j]] += part[i, j]


@njit(cache=True, error_model="numpy")
def principal(matrix, rows):
    """The principal submatrix (k, k) of some rows (k,); `take` along columns is seven times as slow."""
    out = np.empty((rows.size, rows.size))
    for i in range(rows.size):
        row = matrix[rows[i]]
        for j in range(rows.size):
            out[i, j] = row[rows[j]]
    return out


@njit(void(INDEX_MATRIX, MATRIX, MATRIX, MATRIX), cache=True, error_model="numpy")
def gather(at, slope, matrix, out):
    """Fills (R, m) with J times a matrix (n, m); each row of the sparse J has q entries `slope` in columns `at` (R, q)."""
    for r in range(at.shape[0]):
        out[r] = 0.0
        for q in range(at.shape[1]):
            factor, row = slope[r, q], matrix[at[r, q]]
            if factor != 0.0:
                for j in range(row.size):
                    out[r, j] += factor * row[j]


@njit(void(INDEX_MATRIX, MATRIX, MATRIX, MATRIX), cache=True, error_model="numpy")
def add_inner(at, slope, rows, out):
    """Adds rows (R, n) times Jᵀ, see `gather`, to a matrix (R, R); the product must be symmetric."""
    for r in range(at.shape[0]):
        for s in range(r + 1):
            total = 0.0
            for q in range(at.shape[1]):
                total += rows[r, at[s, q]] * slope[s, q]
            out[r, s] += total
            if s < r:
                out[s, r] = out[r, s]


@njit(void(CUBE, MATRIX, CUBE), cache=True, error_model="numpy")
def add_turned(said, weight, turn):
    """Adds rows `weight` (R, d) times each particle's `turn` (N, d, d) to `said` (R, 1 + d, N), from its second column on."""
    count, size, particles = said.shape
    lanes = np.empty((size - 1, size - 1, particles))
    for a in range(size - 1):
        for b in range(size - 1):
            for i in range(particles):
                lanes[a, b, i] = turn[i, a, b]
    for r in range(count):
        for a in range(size - 1):
            for b in range(size - 1):
                for i in range(particles):
                    said[r, 1 + a, i] += weight[r, b] * lanes[b, a, i]


@njit(void(CUBE, CUBE, MATRIX, VECTOR), cache=True, error_model="numpy")
def grams(white, info, vector, quad):
    """Fills each particle's HᵀH (N, d, d), Hᵀν (N, d) and νᵀν (N,), from rows [ν H] in `white` (R, 1 + d, N)."""
    count, size, particles = white.shape
    total = np.empty(particles)
    for a in range(size):
        for b in range(a + 1):
            total[:] = 0.0
            for r in range(count):
                for i in range(particles):
                    total[i] += white[r, a, i] * white[r, b, i]
            for i in range(particles):
                if b > 0:
                    info[i, a - 1, b - 1] = info[i, b - 1, a - 1] = total[i]
                elif a > 0:
                    vector[i, a - 1] = total[i]
                else:
                    quad[i] = total[i]


@njit(cache=True, error_model="numpy")
def add_gram(matrix, rows, sign):
    """Adds ± rowsᵀ rows, with rows (k, n), to the lower triangle of a matrix (n, n)."""
    count = rows.shape[0]
    whole = count - count % 4
    for i in range(matrix.shape[0]):  # a row stays in the cache
        for k in range(0, whole, 4):
            a, b, c, d = sign * rows[k, i], sign * rows[k + 1, i], sign * rows[k + 2, i], sign * rows[k + 3, i]
            for j in range(i + 1):
                matrix[i, j] = (((matrix[i, j] + a * rows[k, j]) + b * rows[k + 1, j]) + c * rows[k + 2, j]) + d * rows[
                    k + 3, j
                ]
        for k in range(whole, count):
            factor = sign * rows[k, i]
            for j in range(i + 1):
                matrix[i, j] += factor * rows[k, j]


@njit(cache=True, error_model="numpy")
def mirror(matrix):
    """Copies the lower triangle to the upper one; by tiles, which stay in the cache."""
    n, tile = matrix.shape[0], 32
    for above in range(0, n, tile):
        for left in range(0, above + 1, tile):
            for i in range(above, min(above + tile, n)):
                for j in range(left, min(left + tile, i)):
                    matrix[j, i] = matrix[i, j]


@njit(cache=True, error_model="numpy")
def congruent(matrix, first, size, blocks):
    """The lower triangle of T P Tᵀ (n, n), with P symmetric; T is the identity except for K diagonal blocks.

    They are the first `size` (K,) rows and columns of `blocks` (K, m, m), placed at rows `first` (K,), without overlap.
    """
    out, part = matrix.copy(), np.empty(blocks.shape[1])
    for k in range(first.size):
        for a in range(size[k]):
            row = out[first[k] + a, : first[k] + size[k]]  # entries to the right are not read
            row[:] = 0.0
            for b in range(size[k]):
                weight = blocks[k, a, b]
                for j in range(row.size):
                    row[j] += weight * matrix[first[k] + b, j]
    for i in range(len(out)):
        row = out[i]
        for k in range(first.size):
            if first[k] > i:
                continue
            for a in range(size[k]):
                part[a] = 0.0
                for b in range(size[k]):
                    part[a] += blocks[k, a, b] * row[first[k] + b]
            for a in range(size[k]):
                row[first[k] + a] = part[a]
    return out
