"""Checks of an observation model: predictions, residuals, visibility, derivatives."""

from functools import partial

import numpy as np

from rbpf.conformance.arguments import Example, Scene
from rbpf.conformance.calls import (
    Check,
    FindingError,
    called,
    named,
    require,
    require_close,
    require_shape,
    require_type,
)
from rbpf.conformance.fused import check_kernel
from rbpf.conformance.inverse import check_initialise, check_invert
from rbpf.core.models import Jacobians, ObservationModel, Part
from rbpf.core.numeric import numeric_jacobians

JACOBIAN_TOLERANCE = 1e-5
TURN_STEPS = 720
"""Steps in which a state is turned once around, to come upon the cut of an angle."""


def observation_checks(model: ObservationModel, scene: Scene, example: Example) -> list[Check]:
    """All checks, each to be run by itself after the first."""
    return [
        partial(_check_predict, model, scene),
        partial(_check_residual, model, scene),
        partial(_check_cut, model, scene),
        partial(_check_visible, model, scene),
        partial(_check_jacobians, model, scene),
        partial(check_kernel, model, scene, JACOBIAN_TOLERANCE),
        partial(check_invert, model, scene),
        partial(check_initialise, model, scene, example.landmark),
    ]


def _check_predict(model: ObservationModel, scene: Scene) -> None:
    name = named(model.predict)
    whole = called(model.predict, *scene.args)
    require_shape(f"{name} for states {scene.state.shape}", whole, (*scene.batch, model.dim))
    one = called(model.predict, *scene.one(1, 2).args)
    require_shape(f"{name} for a single state", one, (model.dim,))
    row = whole[1, min(2, whole.shape[1] - 1)]
    require_close(f"{name} does not broadcast, for a single state", one, row, 1e-9)
    for part in model.reads:
        stacked = called(model.predict, *scene.moved((2, 3), part).args)
        require_shape(f"{name} with two more axes of {part.value}", stacked, (2, 3, *whole.shape))
        require_close(f"{name} does not broadcast, with two more leading axes", stacked[1, 2], whole, 1e-9)


def _check_residual(model: ObservationModel, scene: Scene) -> None:
    name, predicted = named(model.residual), model.predict(*scene.args)
    z = predicted[0]
    residual = called(model.residual, z, predicted)
    require_shape(f"{name} of z {z.shape} and predictions {predicted.shape}", residual, predicted.shape)
    zero = called(model.residual, predicted, predicted)
    require_close(f"{name} of a prediction and itself", zero, np.zeros_like(zero), 1e-12)
    step = 1e-4 * np.arange(1, model.dim + 1)
    moved = called(model.residual, predicted + step, predicted)
    require_close(f"{name} of h + δ and h is not δ", moved, np.broadcast_to(step, moved.shape), 1e-9)


def _check_cut(model: ObservationModel, scene: Scene) -> None:
    """While the state turns around an axis of its chart, no residual may jump by 2π between two small steps."""
    if Part.STATE not in model.reads:
        return
    angles = np.linspace(0.0, 2 * np.pi, TURN_STEPS)[:, None, None, None]
    for axis in np.eye(scene.space.dim):
        turned = scene.space.retract(scene.state, angles * axis)
        predicted = model.predict(turned, *scene.args[1:])
        step = np.abs(called(model.residual, predicted[1:], predicted[:-1])).astype(float)
        if scene.landmark is not None:
            seen = called(model.visible, turned, scene.landmark, scene.const)
            if seen.shape != predicted.shape[:-1] or seen.dtype != bool:
                return  # a finding of its own
            step[~(seen[1:] & seen[:-1])] = np.inf
        alone = (step[:-2] < 0.5) & (
            step[2:] < 0.5
        )  # pixels that move fast also pass 2π, with their neighbours
        jumps = alone & (np.abs(step[1:-1] - 2 * np.pi) < 0.5)
        where = np.flatnonzero(jumps.reshape(-1, model.dim).any(axis=0)).tolist()
        require(
            not where, f"{named(model.residual)} jumps by 2π in component {where}: wrap angles to [−π, π)"
        )


def _check_visible(model: ObservationModel, scene: Scene) -> None:
    if scene.landmark is None:
        return
    seen = called(model.visible, scene.state, scene.landmark, scene.const)
    require_shape(named(model.visible), seen, scene.batch)
    require(seen.dtype == bool, f"{named(model.visible)} returns {seen.dtype}, expected bool")


def _check_jacobians(model: ObservationModel, scene: Scene) -> None:
    analytic = called(model.jacobians, *scene.args)
    name = named(model.jacobians)
    require_type(name, analytic, Jacobians, type(None))
    if analytic is None:
        return
    for block, expected in numeric_jacobians(model, scene.space, *scene.args)._asdict().items():
        if expected is None:
            continue
        found = getattr(analytic, block)
        if found is None:
            raise FindingError(f"{name} gives no derivative by the {block}, which the model reads")
        constant = expected.shape[-2:]
        require_shape(f"{name}: block {block}", found, expected.shape, constant)
        found = np.broadcast_to(found, expected.shape)
        what = f"{name}: block {block} differs from the numeric derivative"
        require_close(what, found, expected, JACOBIAN_TOLERANCE)
