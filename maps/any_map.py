"""What every map does alike: numbers for new landmarks, and what the particles expect to measure of the ones they hold."""

from collections.abc import Callable

import numpy as np

from rbpf import gaussian
from rbpf.arrays import numbers
from rbpf.core.linearisation import linearise
from rbpf.core.models import Belief, ObservationModel, Records
from rbpf.errors import InputError
from rbpf.kernels.landmarks import linearise_all
from rbpf.lie import LieGroup
from rbpf.maps.rows import fused_kernel


def expected(model: ObservationModel, records: Records, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """What each particle expects to measure of landmarks (N, K, p), and J P Jᵀ + H Q Hᵀ (N, K, p, p)."""
    prior, state = belief.prior, belief.state[:, None, :]
    predicted = model.predict(state, records.mean, records.const)
    _, jac = linearise(model, prior.space, predicted, state, records.mean, records.const)
    assert jac.state is not None and jac.landmark is not None
    moved = jac.state @ prior.spread(prior.mean)[:, None]
    within = jac.landmark @ records.cov @ np.swapaxes(jac.landmark, -1, -2)
    return predicted, gaussian.symmetrise(within + moved @ np.swapaxes(moved, -1, -2))


def projected(model: ObservationModel, records: Records, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """The moments (K, p), (K, p, p) of all particles' expectations together, see `Belief.project`."""
    predicted, within = expected(model, records, belief)
    # Relative to the particle of highest weight, so that angles need not be wrapped.
    mode = predicted[belief.mode]
    mean, cov = gaussian.mixture_moments(belief.weights, model.residual(predicted, mode), within)
    return mode + mean, cov


def checked_new_ids(
    ids: np.ndarray | None, count: int, next_id: int, holds: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Numbers (K,) of `count` new landmarks, from `next_id` on where none are given.

    Raises InputError: not new, not whole.
    """
    if ids is None:
        return np.arange(next_id, next_id + count)
    ids = np.asarray(ids)
    if ids.shape != (count,) or ids.dtype.kind not in "iu" or (ids < 0).any():
        raise InputError(f"ids of {count} new landmarks must be as many whole numbers from 0 up, got {ids}")
    numbers, times = np.unique(ids, return_counts=True)
    taken = numbers[holds(numbers) | (times > 1)]
    if taken.size:
        raise InputError(f"a new landmark needs an id of its own: {taken[0]} is in use")
    return ids.astype(np.int64)


def first_records(model: ObservationModel, z: np.ndarray, cov: np.ndarray, state: np.ndarray) -> Records:
    """Estimates (N, K, …) of landmarks that are started by measurements z (K, p), cov (K, p, p) at states (N, E)."""
    name = type(model).__name__
    return model.initialise(state, numbers(z, f"z of {name}"), numbers(cov, f"cov of {name}"))


def linearised(
    model: ObservationModel,
    space: LieGroup,
    z: np.ndarray,
    state: np.ndarray,
    mean: np.ndarray,
    const: np.ndarray | None,
    compiled: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ν (N, K, p), ∂z/∂state (N, K, p, d), ∂z/∂landmark (N, K, p, D) of landmarks (N, K, D) at states (N, E)."""
    (n, k, dim), p = mean.shape, z.shape[1]
    kernel = fused_kernel(model) if compiled else None
    if kernel is None:
        nu, jac = linearise(model, space, z, state[:, None], mean, const)
        assert jac.state is not None and jac.landmark is not None
        return nu, jac.state, jac.landmark
    held = np.empty((n, k, 0)) if const is None else np.broadcast_to(const, (n, *const.shape[1:]))
    nu, by_state, by_landmark = np.empty((n, k, p)), np.empty((n, k, p, space.dim)), np.empty((n, k, p, dim))
    arrays = (np.require(array, np.float64, ["C", "W"]) for array in (state, mean, held, z))
    linearise_all(kernel.function.address, kernel.params, *arrays, nu, by_state, by_landmark)
    return nu, by_state, by_landmark
