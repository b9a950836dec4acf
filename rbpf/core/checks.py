"""What a filter refuses before it can reach a kernel: one sentence each."""

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Observations, Part, Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup


def checked_transition(transition: Transition, state: np.ndarray, space: LieGroup, what: str) -> Transition:
    """A transition of the states (N, E).

    Raises:
        InputError: its mean or noise factor has the wrong shape, or is not finite.
    """
    mean, factor, n = transition.mean, transition.noise_factor, state.shape[0]
    rows = space.dim + (0 if transition.coupling is None else transition.coupling.shape[-1])
    fits = factor.ndim == 3 and factor.shape[0] in (1, n) and factor.shape[1] == rows
    if mean.shape != state.shape or not fits:
        raise InputError(
            f"{what} returned mean {mean.shape} and noise_factor {factor.shape}: "
            f"expected {state.shape} and ({n} or 1, {rows}, r)"
        )
    if not (np.isfinite(mean).all() and np.isfinite(factor).all()):
        raise InputError(f"{what} returned NaN or infinity: check the control")
    return transition


def checked_observations(group: Observations) -> Observations:
    """A group of observations.

    Raises:
        InputError: z or cov has the wrong shape, or is not finite, or a cov is no covariance.
    """
    name, count, p = type(group.model).__name__, group.z.shape[0], group.model.dim
    if group.z.shape != (count, p) or group.cov.shape != (count, p, p):
        raise InputError(
            f"{name} measures {p} numbers: expected z (K, {p}) and cov (K, {p}, {p}), "
            f"got {group.z.shape} and {group.cov.shape}"
        )
    updates = group.updates
    if not (isinstance(updates, frozenset) and updates and updates <= {Part.STATE, Part.LANDMARK}):
        raise InputError(
            f"observations of {name} inform a frozenset of Part.STATE, Part.LANDMARK or both, got {updates}"
        )
    if Part.STATE not in updates and Part.LANDMARK not in group.model.reads:
        raise InputError(f"{name} reads no landmark: its observations must inform Part.STATE")
    if _are_sound(group.z, group.cov):
        return group
    if not (np.isfinite(group.z).all() and np.isfinite(group.cov).all()):
        raise InputError(f"a measurement of {name} or its covariance is not finite")
    try:
        gaussian.psd_factor(group.cov)
    except InputError as error:
        raise InputError(f"the noise of {name} has no covariance: {error}") from error
    return group


def checked_ancestors(ancestors: np.ndarray, n: int, resampler: object) -> np.ndarray:
    """Ancestors (N,) of a resampler.

    Raises:
        InputError: one is missing, or is no particle.
    """
    if ancestors.shape != (n,) or ancestors.min() < 0 or ancestors.max() >= n:
        name = type(resampler).__name__
        raise InputError(f"{name} must return {n} ancestors in 0..{n - 1}, got {ancestors}")
    return ancestors


def checked_start(start: np.ndarray, n: int, space: LieGroup) -> np.ndarray:
    """States (N, E) from one for all particles or one each.

    Raises:
        InputError: the shape is another one, or a number is not finite.
    """
    size = space.size
    if start.shape not in ((size,), (n, size)) or not np.isfinite(start).all():
        what = f"start must be ({size},) or ({n}, {size}) finite numbers"
        raise InputError(f"{what}, got {start.shape}: {start.tolist()}")
    return np.array(np.broadcast_to(start, (n, size)))


def _are_sound(z: np.ndarray, cov: np.ndarray) -> bool:
    """Whether all is finite and the covariances are positive definite: the usual case, told quickly."""
    from rbpf.kernels.soundness import are_sound

    return bool(are_sound(np.ascontiguousarray(z, dtype=float), np.ascontiguousarray(cov, dtype=float)))
