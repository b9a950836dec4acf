"""Checks of an observation model: predictions, residuals, visibility, derivatives, its kernel, how it starts landmarks."""

from functools import partial

import numpy as np

from rbpf.conformance.trial import (
    Check,
    FindingError,
    Scene,
    called,
    named,
    require,
    require_close,
    require_covariance,
    require_shape,
    require_truths,
    require_type,
)
from rbpf.core.linearisation import numeric_jacobians
from rbpf.core.models import FusedKernel, Jacobians, Landmark, ObservationModel, Part, Records
from rbpf.kernels.landmarks import call_kernel
from rbpf.kernels.signature import BLOCK

JACOBIAN_TOLERANCE = 1e-5
KERNEL_TOLERANCE = 1e-9
ROUND_TRIP_TOLERANCE = 1e-7
TURN_STEPS = 720
"""Steps in which a state is turned once around, to come upon the cut of an angle."""
STD = 1e-3
"""Of the measurement noise that first estimates are made with, in the measurement's units."""
GUARD = 64 * BLOCK
"""Numbers in front of and behind each output of a kernel, which it must leave alone."""
_MARK = 1.5e300
_OUTPUTS = ("nu", "jac_state", "jac_landmark")


def observation_checks(model: ObservationModel, scene: Scene, landmark: Landmark | None) -> list[Check]:
    """All checks, each to be run by itself after the first."""
    checks = (check_predict, check_residual, check_cut, check_visible, check_jacobians, check_kernel, check_invert)
    return [*(partial(check, model, scene) for check in checks), partial(check_initialise, model, scene, landmark)]


def check_predict(model: ObservationModel, scene: Scene) -> None:
    """The shape of predictions, and that they broadcast."""
    name = named(model.predict)
    whole = called(model.predict, *scene.args)
    require_shape(f"{name} for states {scene.state.shape}", whole, (*scene.batch, model.dim))
    one = called(model.predict, *scene.one(1, 2).args)
    require_shape(f"{name} for a single state", one, (model.dim,))
    row = whole[1, min(2, whole.shape[1] - 1)]
    require_close(f"{name} does not broadcast, for a single state", one, row, 1e-9)
    for part in model.reads:
        stacked = called(model.predict, *scene.moved((2, 3), part).args)
        require_shape(f"{name} with two more axes of {part}", stacked, (2, 3, *whole.shape))
        require_close(f"{name} does not broadcast, with two more leading axes", stacked[1, 2], whole, 1e-9)


def check_residual(model: ObservationModel, scene: Scene) -> None:
    """The residual of h and h is zero, and that of h + δ is δ."""
    name, predicted = named(model.residual), model.predict(*scene.args)
    z = predicted[0]
    residual = called(model.residual, z, predicted)
    require_shape(f"{name} of z {z.shape} and predictions {predicted.shape}", residual, predicted.shape)
    zero = called(model.residual, predicted, predicted)
    require_close(f"{name} of a prediction and itself", zero, np.zeros_like(zero), 1e-12)
    step = 1e-4 * np.arange(1, model.dim + 1)
    moved = called(model.residual, predicted + step, predicted)
    require_close(f"{name} of h + δ and h is not δ", moved, np.broadcast_to(step, moved.shape), 1e-9)


def check_cut(model: ObservationModel, scene: Scene) -> None:
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
        # Pixels that move fast also pass 2π, with their neighbours.
        alone = (step[:-2] < 0.5) & (step[2:] < 0.5)
        jumps = alone & (np.abs(step[1:-1] - 2 * np.pi) < 0.5)
        where = np.flatnonzero(jumps.reshape(-1, model.dim).any(axis=0)).tolist()
        require(not where, f"{named(model.residual)} jumps by 2π in component {where}: wrap angles to [−π, π)")


def check_visible(model: ObservationModel, scene: Scene) -> None:
    """Truth values of the right shape."""
    if scene.landmark is None:
        return
    require_truths(named(model.visible), called(model.visible, scene.state, scene.landmark, scene.const), scene.batch)


def check_jacobians(model: ObservationModel, scene: Scene) -> None:
    """Analytic derivatives are the numeric ones."""
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


def check_kernel(model: ObservationModel, scene: Scene) -> None:
    """The fused kernel is NumPy's twin: innovation and Jacobians of a block of particles, full and partly filled."""
    fused, name = model.kernel(), named(model.kernel)
    require_type(name, fused, FusedKernel, type(None))
    if fused is None or scene.landmark is None:
        return
    plain = isinstance(fused.params, np.ndarray) and fused.params.dtype.kind in "fiub"
    require(plain and fused.params.ndim == 1, f"{name} gives params that are not one axis of numbers")
    lanes = scene.lanes()
    analytic = model.jacobians(*lanes.args)
    twin = analytic or numeric_jacobians(model, lanes.space, *lanes.args)
    tolerance = JACOBIAN_TOLERANCE if analytic is None else KERNEL_TOLERANCE
    predicted = model.predict(*lanes.args)
    for lane, count in ((0, min(BLOCK, predicted.shape[0])), (1, 3)):
        nu, found = _run(name, fused, lanes, predicted[lane], count)
        expected_nu = model.innovation(predicted[lane], *lanes.args)[:count]
        require_close(f"{name}: nu differs from residual(z, predict)", nu, expected_nu, KERNEL_TOLERANCE)
        for block in ("state", "landmark"):
            what, expected = f"{name}: jac_{block} differs from NumPy's", getattr(twin, block)[:count]
            require_close(what, getattr(found, block), expected, tolerance)


def _run(name: str, fused: FusedKernel, lanes: Scene, z: np.ndarray, count: int) -> tuple[np.ndarray, Jacobians]:
    """ν (count, p) and the Jacobians of the first lanes, each written between two guards."""
    assert lanes.landmark is not None
    shapes = ((z.size, BLOCK), (z.size, lanes.space.dim, BLOCK), (z.size, lanes.landmark.shape[-1], BLOCK))
    guarded = [np.full(2 * GUARD + int(np.prod(shape)), _MARK) for shape in shapes]
    outputs = [array[GUARD:-GUARD].reshape(shape) for array, shape in zip(guarded, shapes, strict=True)]
    for output in outputs:
        output[...] = np.nan
    # (lanes, size) → (size, BLOCK); lanes beyond the last repeat it, so that no lane holds garbage.
    rows = np.minimum(np.arange(BLOCK), lanes.state.shape[0] - 1)
    parts = lanes.state, lanes.landmark, lanes.const
    inputs = [np.zeros((0, BLOCK)) if part is None else np.ascontiguousarray(part[rows].T) for part in parts]
    try:
        numbers = np.array(z, dtype=float), np.array(fused.params, dtype=float)
        call_kernel(fused.function.address, *inputs, *numbers, count, *outputs)
    except AttributeError as error:
        raise FindingError(f"{name} gives no fused kernel: decorate it with @observation_kernel") from error
    for what, array, output in zip(_OUTPUTS, guarded, outputs, strict=True):
        intact = (array[:GUARD] == _MARK).all() and (array[-GUARD:] == _MARK).all()
        require(intact, f"{name} writes outside {what}, which has shape {output.shape}")
    # The drivers hand over zeros: a kernel need not fill the last columns, of a part of the state that it ignores.
    by_state = outputs[1][..., :count]
    read = int(np.max(np.flatnonzero(~np.isnan(by_state).all(axis=(0, 2))), initial=-1)) + 1
    by_state[:, read:] = 0.0
    for what, output in zip(_OUTPUTS, outputs, strict=True):
        filled = np.isfinite(output[..., :count]).all()
        require(filled, f"{name} leaves entries of {what} unfilled, or fills them with NaN")
    nu, jac_state, jac_landmark = (np.moveaxis(output[..., :count], -1, 0) for output in outputs)
    return nu, Jacobians(jac_state, jac_landmark)


def check_invert(model: ObservationModel, scene: Scene) -> None:
    """predict(state, invert(state, z)) is z."""
    if scene.landmark is None or type(model).invert is ObservationModel.invert:
        return
    z = model.predict(*scene.args)
    landmark = called(model.invert, scene.state, z)
    name = named(model.invert)
    require_shape(f"{name} for z {z.shape}", landmark, scene.landmark.shape)
    residual = model.residual(z, model.predict(scene.state, landmark, scene.const))
    what = f"{name} is not the inverse of predict, residual of z and predict(invert(z))"
    require_close(what, residual, np.zeros_like(residual), ROUND_TRIP_TOLERANCE)


def check_initialise(model: ObservationModel, scene: Scene, landmark: Landmark | None) -> None:
    """First estimates have the parametrisation's shapes, a covariance, and predict what was measured."""
    overridden = type(model).initialise is not ObservationModel.initialise
    if scene.landmark is None or not (overridden or type(model).invert is not ObservationModel.invert):
        return
    name, z = named(model.initialise), model.predict(*scene.args)[0]
    cov = np.repeat(STD**2 * np.eye(model.dim)[None], z.shape[0], axis=0)
    records = called(model.initialise, scene.state[:, 0], z, cov)
    require_type(name, records, Records)
    lead = (scene.state.shape[0], scene.landmark.shape[1])
    components, dim = 1 if landmark is None else landmark.components, scene.landmark.shape[-1]
    inner = lead if components == 1 else (*lead, components)
    require_shape(f"{name}: mean", records.mean, (*inner, dim))
    require_shape(f"{name}: cov", records.cov, (*inner, dim, dim))
    require_covariance(f"{name}: cov", records.cov)
    if components > 1:
        require_shape(f"{name}: log_weights", records.log_weights, inner)
        total = np.exp(np.asarray(records.log_weights)).sum(axis=-1)
        require_close(f"{name}: weights of the components", total, np.ones_like(total), 1e-9)
    if landmark is not None and landmark.constants:
        require_shape(f"{name}: const", records.const, (*lead, landmark.constants))
    if records.log_weights is None:
        distance = np.abs(model.residual(z, model.predict(scene.state, records.mean, records.const))).max()
        what = f"{name} gives estimates whose prediction is {distance:.3g} away from z"
        require(distance <= STD, f"{what}, expected less than its standard deviation {STD}")
