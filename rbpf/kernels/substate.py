"""Driver: the joint law of a state's increment and a linear substate, turned into the one given the other."""

import math

import numpy as np
from numba import boolean, njit

from rbpf.kernels.signature import CUBE

_SINGULAR = 1e-12
"""The same as `rbpf.gaussian.psd_factor`'s: a pivot below this fraction of its variance is none."""


@njit(cache=True, error_model="numpy")
def _joint(stack, cov, noise, half, joint):
    """S P Sᵀ + L Lᵀ, exactly symmetric."""
    rows, m = stack.shape
    for a in range(rows):
        for c in range(m):
            total = 0.0
            for b in range(m):
                total += stack[a, b] * cov[b, c]
            half[a, c] = total
    for a in range(rows):
        for b in range(a + 1):
            total = 0.0
            for c in range(m):
                total += half[a, c] * stack[b, c]
            for r in range(noise.shape[1]):
                total += noise[a, r] * noise[b, r]
            joint[a, b] = joint[b, a] = total


@njit(cache=True, error_model="numpy")
def _cholesky(joint, factor):
    """Lower factor of the leading block; whether it is definite."""
    d = factor.shape[0]
    factor[:] = 0.0
    for j in range(d):
        pivot = joint[j, j]
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k]
        if not pivot > _SINGULAR * joint[j, j]:
            return False
        factor[j, j] = math.sqrt(pivot)
        for i in range(j + 1, d):
            rest = joint[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            factor[i, j] = rest / factor[j, j]
    return True


@njit(cache=True, error_model="numpy")
def _solve(joint, factor, gain):
    """Gain = C L⁻ᵀ L⁻¹ of the cross-covariance C."""
    d, m = factor.shape[0], gain.shape[0]
    for a in range(m):
        for j in range(d):
            total = joint[d + a, j]
            for k in range(j):
                total -= factor[j, k] * gain[a, k]
            gain[a, j] = total / factor[j, j]
        for j in range(d - 1, -1, -1):
            total = gain[a, j]
            for k in range(j + 1, d):
                total -= factor[k, j] * gain[a, k]
            gain[a, j] = total / factor[j, j]


@njit(cache=True, error_model="numpy")
def _condition(joint, gain, half, rest):
    """Rest = [−G I] J [−G I]ᵀ, which rounding cannot make indefinite."""
    m, d = gain.shape
    for c in range(d + m):
        for a in range(m):
            total = joint[d + a, c]
            for k in range(d):
                total -= gain[a, k] * joint[k, c]
            half[c, a] = total
    for a in range(m):
        for b in range(a + 1):
            total = half[d + b, a]
            for k in range(d):
                total -= half[k, a] * gain[b, k]
            rest[a, b] = rest[b, a] = total


@njit(boolean(CUBE, CUBE, CUBE, CUBE, CUBE, CUBE, CUBE), cache=True, error_model="numpy")
def conditioned(stack, cov, noise, joint, factor, gain, rest):
    """Fills the law of s given ε, for cov(ε, s) = S P Sᵀ + L Lᵀ.

    Fills, for each of J laws, `joint` (J, d+m, d+m), the lower `factor` (J, d, d) of cov(ε), `gain` (J, m, d) =
    cov(s, ε) cov(ε)⁻¹ and `rest` (J, m, m) = cov(s | ε), from `stack` S (J or 1, d+m, m), `cov` P (J or 1, m, m) and
    `noise` L (J or 1, d+m, r). Returns whether every cov(ε) is definite; what depends on it is void where one is not.
    """
    half = np.empty(stack.shape[1:])
    definite = True
    for j in range(joint.shape[0]):
        of_stack, of_cov, of_noise = (
            min(j, stack.shape[0] - 1),
            min(j, cov.shape[0] - 1),
            min(j, noise.shape[0] - 1),
        )
        _joint(stack[of_stack], cov[of_cov], noise[of_noise], half, joint[j])
        definite = _cholesky(joint[j], factor[j]) and definite
        if definite:
            _solve(joint[j], factor[j], gain[j])
            _condition(joint[j], gain[j], half, rest[j])
    return definite
