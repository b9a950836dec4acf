"""Checks of a likelihood."""

from functools import partial

import numpy as np

from rbpf import gaussian
from rbpf.conformance.calls import Check, called, named, require, require_close, require_shape
from rbpf.core.models import Likelihood
from rbpf.kernels.gate import is_inlier, log_likelihood

KERNEL_IDS = (-1, 0, 1, 2)
MASS_TOLERANCE = 5e-3
FAR = 1000.0
"""Standard deviations up to which a density is integrated; out there only a uniform floor is left of it."""


def likelihood_checks(likelihood: Likelihood, rng: np.random.Generator) -> list[Check]:
    """Shapes, mass, and the compiled twin."""
    return [
        partial(_check_shapes, likelihood, rng),
        partial(_check_mass, likelihood),
        partial(_check_twin, likelihood, rng),
    ]


def _innovations(rng: np.random.Generator, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Some within and some far outside of their covariance."""
    factor = rng.normal(size=(5, 4, p, p + 1))
    cov = factor @ np.swapaxes(factor, -1, -2) + 0.1 * np.eye(p)
    return rng.normal(size=(5, 4, p)) * np.array([0.1, 1.0, 3.0, 30.0])[:, None], cov


def _check_shapes(likelihood: Likelihood, rng: np.random.Generator) -> None:
    name = named(likelihood.log_density)
    for p in (1, 2, 3):
        nu, cov = _innovations(rng, p)
        density = called(likelihood.log_density, nu, cov)
        require_shape(f"{name} for ν {nu.shape}", density, (5, 4))
        single = np.asarray(called(likelihood.log_density, nu[1, 2], cov[1, 2]))
        require_close(f"{name} does not broadcast, for a single ν", single, np.asarray(density[1, 2]), 1e-9)
        inlier = called(likelihood.inlier, nu, cov)
        require_shape(f"{named(likelihood.inlier)} for ν {nu.shape}", inlier, (5, 4))
        require(inlier.dtype == bool, f"{named(likelihood.inlier)} returns {inlier.dtype}, expected bool")


def _check_mass(likelihood: Likelihood) -> None:
    """∫ (p − floor) dν is the inliers' fraction; a uniform floor stands for outliers in a bounded volume."""
    if not likelihood.normalised:
        return
    grid = np.sinh(np.linspace(-np.arcsinh(FAR), np.arcsinh(FAR), 20_001))
    expected = float(np.exp(likelihood.log_inlier()))
    for variance in (0.3, 4.0):
        nu = np.sqrt(variance) * grid[:, None]
        density = np.exp(likelihood.log_density(nu, np.full((grid.size, 1, 1), variance)))
        mass = float(np.trapezoid(density - density[0], nu[:, 0]))
        what = f"{named(likelihood.log_density)} integrates to {mass:.4g} at variance {variance}"
        fits = abs(mass - expected) <= MASS_TOLERANCE
        require(fits, f"{what}, expected {expected:.4g}: normalise it, or set normalised = False")


def _check_twin(likelihood: Likelihood, rng: np.random.Generator) -> None:
    """The compiled kernel says the same as NumPy."""
    name, kernel_id, params = type(likelihood).__name__, likelihood.kernel_id, likelihood.params
    require(kernel_id in KERNEL_IDS, f"{name}.kernel_id is {kernel_id}, expected one of {KERNEL_IDS}")
    if kernel_id < 0:
        return
    plain = isinstance(params, np.ndarray) and params.dtype == float and params.ndim == 1
    require(plain, f"{name}.params is not one axis of float64 numbers")
    nu, cov = _innovations(rng, 2)
    chol = gaussian.cholesky(cov)
    squared = np.square(gaussian.solve_lower(chol, nu)).sum(axis=-1)
    scale = np.exp(-0.5 * gaussian.log_det(chol))
    twin, inlier = np.empty_like(squared), np.empty_like(squared, dtype=bool)
    for at in np.ndindex(squared.shape):
        lane = (kernel_id, params, squared[at], scale[at], 2)
        twin[at], inlier[at] = log_likelihood(*lane), is_inlier(*lane)
    what = f"{name}.log_density differs from its compiled kernel {kernel_id}"
    require_close(what, likelihood.log_density(nu, cov), twin, 1e-9)
    same = np.array_equal(likelihood.inlier(nu, cov), inlier)
    require(same, f"{name}.inlier differs from its compiled kernel {kernel_id}")
