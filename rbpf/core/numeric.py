"""Numeric defaults of the models: Jacobians on the manifold, first estimates, promotion to points."""

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Jacobians, Landmark, ObservationModel, Part, Records
from rbpf.errors import InputError
from rbpf.lie import LieGroup

STEP = float(np.finfo(float).eps) ** (1 / 3)
"""Step of the central differences, where truncation and rounding errors balance."""


EVERYTHING = frozenset(Part)


def numeric_jacobians(
    model: ObservationModel,
    space: LieGroup,
    state: np.ndarray,
    landmark: np.ndarray | None = None,
    const: np.ndarray | None = None,
    substate: np.ndarray | None = None,
    by: frozenset[Part] = EVERYTHING,
) -> Jacobians:
    """Central differences of −ν for z = h, in the right chart at the state; `model.residual` wraps.

    Those by a part that `by` does not name are left out: each costs two predictions per coordinate.
    """
    plus_minus = np.array([STEP, -STEP])

    z = model.predict(state, landmark, const, substate)

    def differences(nu: np.ndarray) -> np.ndarray:
        return np.moveaxis(nu[1] - nu[0], 0, -1) / (2 * STEP)

    def perturbed(x: np.ndarray) -> np.ndarray:
        steps = plus_minus[:, None, None] * np.eye(x.shape[-1])
        return x + steps.reshape(2, x.shape[-1], *(1,) * (x.ndim - 1), x.shape[-1])

    state_part = landmark_part = substate_part = None
    wanted = model.reads & by
    if Part.STATE in wanted:
        steps = plus_minus[:, None, None] * np.eye(space.dim)
        moved = space.retract(state, steps.reshape(2, space.dim, *(1,) * (state.ndim - 1), space.dim))
        state_part = differences(model.innovation(z, moved, landmark, const, substate))
    if landmark is not None and Part.LANDMARK in wanted:
        landmark_part = differences(model.innovation(z, state, perturbed(landmark), const, substate))
    if substate is not None and Part.SUBSTATE in wanted:
        substate_part = differences(model.innovation(z, state, landmark, const, perturbed(substate)))
    return Jacobians(state_part, landmark_part, substate_part)


def linearise(
    model: ObservationModel,
    space: LieGroup,
    z: np.ndarray,
    state: np.ndarray,
    landmark: np.ndarray | None = None,
    const: np.ndarray | None = None,
    substate: np.ndarray | None = None,
    by: frozenset[Part] = EVERYTHING,
) -> tuple[np.ndarray, Jacobians]:
    """Innovation (N, K, p) and Jacobians at states (N, 1, E), landmarks (N, K, D), substates (N, 1, m).

    Numeric Jacobians by a part that `by` does not name are left out.

    Raises:
        InputError: a prediction or a Jacobian has the wrong shape.
    """
    nu = model.innovation(z, state, landmark, const, substate)
    parts = (state, landmark, substate)
    expected = (*np.broadcast_shapes(*(part.shape[:-1] for part in parts if part is not None)), model.dim)
    if nu.shape != np.broadcast_shapes(expected, z.shape):
        raise InputError(f"{type(model).__name__}.predict returned shape {nu.shape}, expected {expected}")
    jacobians = model.jacobians(state, landmark, const, substate)
    if jacobians is None:
        jacobians = numeric_jacobians(model, space, state, landmark, const, substate, by)
    sizes = (space.dim, *(0 if part is None else part.shape[-1] for part in parts[1:]))
    blocks = [_full(model, block, (*expected, size)) for block, size in zip(jacobians, sizes, strict=True)]
    return nu, Jacobians(*blocks)


def _full(model: ObservationModel, block: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """A Jacobian with all its leading axes; a constant one may come without them."""
    if block is None:
        return None
    try:
        return np.broadcast_to(block, shape)
    except ValueError as error:
        name = f"{type(model).__name__}.jacobians"
        raise InputError(f"{name} returned a block of shape {block.shape}, expected {shape}") from error


def invert_with_covariance(
    model: ObservationModel, state: np.ndarray, z: np.ndarray, cov: np.ndarray
) -> Records:
    """Landmarks from `model.invert`, with the covariance J R Jᵀ of a numeric derivative by the measurement."""
    at = state[:, None, :]
    mean = model.invert(at, z)
    p = z.shape[-1]
    columns = [
        (model.invert(at, z + STEP * np.eye(p)[j]) - model.invert(at, z - STEP * np.eye(p)[j])) / (2 * STEP)
        for j in range(p)
    ]
    jac = np.stack(columns, axis=-1)
    return Records(mean, gaussian.symmetrise(jac @ cov @ np.swapaxes(jac, -1, -2)))


def promote_to_points(landmark: Landmark, records: Records) -> Records:
    """Single Gaussians of the world points: unscented transform of each component, then moment matching.

    S. Julier and J. Uhlmann, "A new extension of the Kalman filter to nonlinear systems" (1997).
    """
    const = records.const
    if const is not None and landmark.components > 1:
        const = const[:, :, None, :]

    def point(mean: np.ndarray) -> np.ndarray:
        world = landmark.homogeneous(mean, const)
        return world[..., :-1] / world[..., -1:]

    mean, cov, _ = gaussian.unscented_transform(point, records.mean, records.cov)
    if records.log_weights is None:
        return Records(mean, cov)
    weights = np.exp(records.log_weights)[..., None]
    centre = (weights * mean).sum(axis=2)
    spread = mean - centre[:, :, None]
    total = (weights[..., None] * (cov + spread[..., :, None] * spread[..., None, :])).sum(axis=2)
    return Records(centre, total)
