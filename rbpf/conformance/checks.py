"""Checks of motion and observation models, landmarks, likelihoods, sensors and conditionals.

Below are the helpers that call methods and validate their results.
"""

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from functools import partial
from types import NoneType
from typing import Any

import numpy as np
from numpy.random import Generator

from rbpf.conformance.trial import LANDMARKS, PARTICLES, Example, Scene, random_constants
from rbpf.core import models
from rbpf.core.genealogy import Lineage
from rbpf.core.linearisation import numeric_jacobians
from rbpf.core.particles import SUMMED, Information, Prior
from rbpf.errors import InputError
from rbpf.kernels.landmarks import call_kernel
from rbpf.kernels.signature import BLOCK
from rbpf.lie import LieGroup

MASS_TOLERANCE = 5e-3
FAR = 1000.0  #: Standard deviations up to which a density is integrated; out there only a uniform floor is left of it.
ESTIMATE_STD = 0.1  #: Of random estimates of landmarks, in the parametrisation's units.
JACOBIAN_TOLERANCE = 1e-5
KERNEL_TOLERANCE = 1e-9
ROUND_TRIP_TOLERANCE = 1e-7
TURN_STEPS = 720  #: Steps in which a state is turned once around, to come upon the cut of an angle.
STD = 1e-3  #: Of the measurement noise that first estimates are made with, in the measurement's units.
GUARD = 64 * BLOCK  #: Numbers in front of and behind each output of a kernel, which it must leave alone.
_MARK = 1.5e300
_OUTPUTS = ("nu", "jac_state", "jac_landmark")

Check = Callable[[], None]


def motion_checks(model: models.MotionModel, space: LieGroup, rng: Generator, example: Example) -> list[Check]:
    """Shapes, membership of the group, and independence of the particles."""
    name, states = named(model.transition), example.states(space, rng)

    def transition(state: np.ndarray) -> Any:
        return called(model.transition, state, example.control, example.dt, gives=[models.Transition])

    def shapes() -> None:
        nonlocal states
        if models.draws(model):
            drawing, given = named(model.sample), (states, example.control, example.dt)
            first, again = (called(model.sample, *given, np.random.default_rng(1), repeat=False) for _ in range(2))
            require_shape(f"{drawing}: states", first, states.shape)
            same = np.array_equal(first, again)
            require(same, f"{drawing} draws from something else than the generator that it is given")
            what = f"{drawing} leaves the group {space!r}, use its compose or retract"
            require_close(what, first, space.normalise(first), 1e-9)
            states = first
        n, d, m, found = states.shape[0], space.dim, 0, transition(states)
        there = [part is not None for part in (found.coupling, found.dynamics, found.drift)]
        require(len(set(there)) == 1, f"{name} must give coupling, dynamics and drift together, or none of them")
        require_shape(f"{name}: mean", found.mean, (n, space.size))
        if found.coupling is not None:
            require_shape(f"{name}: coupling", found.coupling, (n, d, None), (1, d, None))
            m = found.coupling.shape[-1]
            require_shape(f"{name}: dynamics", found.dynamics, (n, m, m), (1, m, m))
            require_shape(f"{name}: drift", found.drift, (n, m), (1, m))
        require_shape(f"{name}: noise_factor", found.noise_factor, (n, d + m, None), (1, d + m, None))

    def group() -> None:
        mean = transition(states).mean
        what = f"{name}: mean leaves the group {space!r}, use its compose or retract"
        require_close(what, mean, space.normalise(mean), 1e-9)

    def independence() -> None:
        together, what = transition(states), f"{name} mixes particles, for one of them alone"
        for i in range(states.shape[0]):
            alone = transition(states[i : i + 1])
            for part, whole in vars(together).items():
                if whole is not None:
                    row, found = whole[i if whole.shape[0] > 1 else 0], getattr(alone, part)
                    require(found is not None, f"{what}, {part} is missing")
                    require_close(f"{what}, {part}", found[0], row, 1e-9)

    return [shapes, group, independence]


def observation_checks(model: models.ObservationModel, scene: Scene, landmark: models.Landmark | None) -> list[Check]:
    """All checks, each to be run by itself after the first."""
    checks = (check_predict, check_residual, check_cut, check_visible, check_jacobians, check_kernel, check_invert)
    return [*(partial(check, model, scene) for check in checks), partial(check_initialise, model, scene, landmark)]


def check_predict(model: models.ObservationModel, scene: Scene) -> None:
    """The shape of predictions, and that they broadcast."""
    name = named(model.predict)
    whole = called(model.predict, *scene.args)
    require_shape(f"{name} for states {scene.state.shape}", whole, (*scene.batch, model.dim))
    one = called(model.predict, *scene.mapped(lambda part: part[1, min(2, part.shape[1] - 1)]).args)
    require_shape(f"{name} for a single state", one, (model.dim,))
    row = whole[1, min(2, whole.shape[1] - 1)]
    require_close(f"{name} does not broadcast, for a single state", one, row, 1e-9)
    for part in model.reads:
        stacked = called(model.predict, *scene.moved((2, 3), part).args)
        require_shape(f"{name} with two more axes of {part}", stacked, (2, 3, *whole.shape))
        require_close(f"{name} does not broadcast, with two more leading axes", stacked[1, 2], whole, 1e-9)


def check_residual(model: models.ObservationModel, scene: Scene) -> None:
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


def check_cut(model: models.ObservationModel, scene: Scene) -> None:
    """While the state rotates about an axis of its chart, no residual may jump by 2π between two small steps."""
    if models.Part.STATE not in model.reads:
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


def check_visible(model: models.ObservationModel, scene: Scene) -> None:
    """Truth values of the right shape."""
    if scene.landmark is None:
        return
    require_truths(named(model.visible), called(model.visible, scene.state, scene.landmark, scene.const), scene.batch)


def check_jacobians(model: models.ObservationModel, scene: Scene) -> None:
    """Analytic derivatives are the numeric ones."""
    name, analytic = named(model.jacobians), called(model.jacobians, *scene.args, gives=[models.Jacobians, NoneType])
    if analytic is None:
        return
    for block, expected in numeric_jacobians(model, scene.space, *scene.args)._asdict().items():
        if expected is None:
            continue
        found = getattr(analytic, block)
        if found is None:
            raise FindingError(f"{name} gives no derivative by the {block}, which the model reads")
        require_shape(f"{name}: block {block}", found, expected.shape, expected.shape[-2:])
        found = np.broadcast_to(found, expected.shape)
        what = f"{name}: block {block} differs from the numeric derivative"
        require_close(what, found, expected, JACOBIAN_TOLERANCE)


def check_kernel(model: models.ObservationModel, scene: Scene) -> None:
    """The fused kernel is NumPy's twin: innovation and Jacobians of a block of particles, full and partly filled."""
    fused, name = model.kernel(), named(model.kernel)
    require_type(name, fused, models.FusedKernel, NoneType)
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


def _run(
    name: str, fused: models.FusedKernel, lanes: Scene, z: np.ndarray, count: int
) -> tuple[np.ndarray, models.Jacobians]:
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
    return nu, models.Jacobians(jac_state, jac_landmark)


def check_invert(model: models.ObservationModel, scene: Scene) -> None:
    """predict(state, invert(state, z)) is z."""
    if scene.landmark is None or type(model).invert is models.ObservationModel.invert:
        return
    z = model.predict(*scene.args)
    landmark = called(model.invert, scene.state, z)
    name = named(model.invert)
    require_shape(f"{name} for z {z.shape}", landmark, scene.landmark.shape)
    residual = model.residual(z, model.predict(scene.state, landmark, scene.const))
    what = f"{name} is not the inverse of predict, residual of z and predict(invert(z))"
    require_close(what, residual, np.zeros_like(residual), ROUND_TRIP_TOLERANCE)


def check_initialise(model: models.ObservationModel, scene: Scene, landmark: models.Landmark | None) -> None:
    """First estimates have the parametrisation's shapes, a covariance, and predict what was measured."""
    overridden = type(model).initialise is not models.ObservationModel.initialise
    if scene.landmark is None or not (overridden or type(model).invert is not models.ObservationModel.invert):
        return
    name, z = named(model.initialise), model.predict(*scene.args)[0]
    cov = np.repeat(STD**2 * np.eye(model.dim)[None], z.shape[0], axis=0)
    records = called(model.initialise, scene.state[:, 0], z, cov, gives=[models.Records])
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


def landmark_checks(landmark: models.Landmark, space: LieGroup | None, rng: Generator, example: Example) -> list[Check]:
    """Sizes, world points, readiness and promotion."""

    def tried() -> models.Records:
        if example.records is not None:
            return example.records
        lead, dim = (PARTICLES, LANDMARKS), landmark.dim
        inner = lead if landmark.components == 1 else (*lead, landmark.components)
        factor = ESTIMATE_STD * rng.normal(size=(*inner, dim, dim + 1))
        log_weights = np.full(inner, -np.log(landmark.components)) if landmark.components > 1 else None
        const = random_constants(landmark, space, rng, lead)
        cov = factor @ np.swapaxes(factor, -1, -2)
        return models.Records(rng.normal(size=(*inner, dim)), cov, const, log_weights)

    def world_points() -> None:
        for size, least in (("dim", 1), ("constants", 0), ("components", 1)):
            value, what = getattr(landmark, size, None), f"{type(landmark).__name__}.{size}"
            fits = isinstance(value, int) and value >= least
            require(fits, f"{what} is {value!r}, expected an integer of at least {least}")
        records = tried()
        name, lead, const = named(landmark.homogeneous), records.mean.shape[:-1], records.const
        if const is not None and landmark.components > 1:
            const = const[:, :, None, :]
        whole = called(landmark.homogeneous, records.mean, const)
        require_shape(f"{name} for means {records.mean.shape}", whole, (*lead, 4), (*lead, 3))
        first = (0,) * len(lead)
        one = called(landmark.homogeneous, records.mean[first], None if const is None else const[first])
        require_shape(f"{name} for a single mean", one, whole.shape[-1:])
        require_close(f"{name} does not broadcast, for a single mean", one, whole[first], 1e-9)
        stacked = called(landmark.homogeneous, np.stack([records.mean, records.mean]), const)
        require_shape(f"{name} for means with one more leading axis", stacked, (2, *whole.shape))

    def readiness() -> None:
        records, name = tried(), named(landmark.ready)
        require_truths(name, called(landmark.ready, records), records.mean.shape[:2])

    def promotion() -> None:
        records, name = tried(), named(landmark.promote)
        promoted, lead = called(landmark.promote, records, gives=[models.Records]), records.mean.shape[:2]
        require_shape(f"{name}: mean", promoted.mean, (*lead, 2), (*lead, 3))
        size = promoted.mean.shape[-1]
        require_shape(f"{name}: cov", promoted.cov, (*lead, size, size))
        require_covariance(f"{name}: cov", promoted.cov)

    return [world_points, readiness, promotion]


def likelihood_checks(likelihood: models.Likelihood, rng: Generator) -> list[Check]:
    """Shapes, and mass."""
    log_density, inlier = likelihood.log_density, likelihood.inlier

    def innovations(p: int) -> tuple[np.ndarray, np.ndarray]:
        """Some within and some far outside of their covariance."""
        factor = rng.normal(size=(5, 4, p, p + 1))
        cov = factor @ np.swapaxes(factor, -1, -2) + 0.1 * np.eye(p)
        return rng.normal(size=(5, 4, p)) * np.array([0.1, 1.0, 3.0, 30.0])[:, None], cov

    def shapes() -> None:
        name = named(log_density)
        for p in (1, 2, 3):
            nu, cov = innovations(p)
            density = called(log_density, nu, cov)
            require_shape(f"{name} for ν {nu.shape}", density, (5, 4))
            single = np.asarray(called(log_density, nu[1, 2], cov[1, 2]))
            what = f"{name} does not broadcast, for a single ν"
            require_close(what, single, np.asarray(density[1, 2]), 1e-9)
            require_truths(f"{named(inlier)} for ν {nu.shape}", called(inlier, nu, cov), (5, 4))

    def mass() -> None:
        """∫ (p − floor) dν is the inliers' fraction; a uniform floor stands for outliers in a bounded volume."""
        if not likelihood.normalised:
            return
        grid = np.sinh(np.linspace(-np.arcsinh(FAR), np.arcsinh(FAR), 20_001))
        expected = float(np.exp(likelihood.log_inlier()))
        for variance in (0.3, 4.0):
            nu = np.sqrt(variance) * grid[:, None]
            density = np.exp(log_density(nu, np.full((grid.size, 1, 1), variance)))
            found = float(np.trapezoid(density - density[0], nu[:, 0]))
            what = f"{named(log_density)} integrates to {found:.4g} at variance {variance}"
            fits = abs(found - expected) <= MASS_TOLERANCE
            require(fits, f"{what}, expected {expected:.4g}: normalise it, or set normalised = False")

    return [shapes, mass]


def sensor_checks(sensor: models.Sensor, example: Example) -> list[Check]:
    """Its observations, then its new landmarks."""
    belief = example.belief
    if belief is None:
        name = type(sensor).__name__
        raise InputError(f"{name} is tried on a frame and a belief: give Example(frame=…, belief=…)")
    n = belief.log_weights.size

    def measurements(name: str, group: models.Observations | models.NewLandmarks) -> None:
        k, p, model = group.z.shape[0], group.model.dim, type(group.model).__name__
        require_shape(f"{name}: z of {model}", group.z, (None, p))
        require_shape(f"{name}: cov of {model}", group.cov, (k, p, p))
        require_covariance(f"{name}: cov of {model}", group.cov)

    def observed() -> None:
        name = named(sensor.observe)
        for group in groups_of(sensor, example):
            require_type(f"{name}, for a group,", group, models.Observations)
            if group.data is not None:
                continue
            measurements(name, group)
            if models.Part.LANDMARK not in group.model.reads:
                continue
            k, ids = group.z.shape[0], group.ids
            if ids is None:
                raise FindingError(f"{name} gives no ids, but {type(group.model).__name__} reads a landmark")
            require_shape(f"{name}: ids", ids, (k,), (n, k))
            require(ids.dtype.kind == "i", f"{name}: ids are {ids.dtype}, expected integers")
            unknown = np.setdiff1d(ids[ids >= 0], belief.map.ids).tolist()
            require(not unknown, f"{name} names landmarks {unknown}, which the map does not hold")
            known = (ids >= models.NEW).all()
            require(known, f"{name}: ids below {models.NEW} mean nothing, expected a landmark, NULL or NEW")

    def started() -> None:
        name, groups = named(sensor.new_landmarks), groups_of(sensor, example)
        for new_landmarks in called(sensor.new_landmarks, example.frame, belief, groups, repeat=False):
            require_type(f"{name}, for a group,", new_landmarks, models.NewLandmarks)
            measurements(name, new_landmarks)
            k = new_landmarks.z.shape[0]
            if new_landmarks.mask is not None:
                require_shape(f"{name}: mask", new_landmarks.mask, (n, k))
            if new_landmarks.ids is not None:
                require_shape(f"{name}: ids", new_landmarks.ids, (k,))
                taken = new_landmarks.ids[belief.map.holds(new_landmarks.ids)].tolist()
                require(not taken, f"{name} starts landmarks {taken}, which the map holds already")

    return [observed, started]


def conditional_checks(part: models.Conditional, space: LieGroup, rng: Generator, example: Example) -> list[Check]:
    """A few steps of a conditional: shapes, side effects of predictions, copies, and the checkpoint."""
    states, groups = example.states(space, rng), example.groups
    n, d = states.shape[0], space.dim
    alike = np.repeat(states[:1], n, axis=0)
    lineages: list[Lineage] = []

    def begin() -> None:
        lineages.append(Lineage(n))
        called(part.begin, n, lineages[-1], repeat=False)

    def held() -> dict[str, np.ndarray]:
        arrays, name = called(part.arrays), named(part.arrays)
        plain = isinstance(arrays, dict) and all(isinstance(array, np.ndarray) for array in arrays.values())
        require(plain, f"{name} must return NumPy arrays by name")
        return {key: array.copy() for key, array in arrays.items()}

    def unchanged(before: dict[str, np.ndarray], what: str) -> None:
        now = held()
        same = before.keys() == now.keys() and all(np.array_equal(now[key], before[key], equal_nan=True) for key in now)
        require(same, what)

    def predicted(state: np.ndarray) -> Prior:
        transition = example.transition or models.Transition(state, np.zeros((1, d, 1)))
        prior = called(part.predict, transition, space, example.dt, gives=[Prior, NoneType])
        return prior or Prior(space, transition.mean, np.zeros((1, d)), transition.noise_factor[:, :d])

    def corrected(state: np.ndarray) -> Any:
        moved = space.local(predicted(state).base, state)
        return called(part.correct, state, moved, groups, repeat=False, gives=[models.LogDensities])

    def life() -> None:
        what = f"{type(part).__name__}.supplies is {part.supplies!r}, expected a Part"
        require(isinstance(part.supplies, models.Part), what)
        begin()
        before = held()
        prior = predicted(states)
        unchanged(before, f"{named(part.predict)} changes what is held: a step may be looked at and not be taken")
        name, found = named(part.information), Information.zeros(n, d)
        if groups:
            found = called(part.information, states, groups, prior, gives=[Information])
        for block, shape in (("info", (n, d, d)), ("vector", (n, d)), *((other, (n,)) for other in SUMMED[2:])):
            require_shape(f"{name}: {block}", getattr(found, block), shape)
        unchanged(before, f"{name} changes what is held: a proposal may linearise several times, or not at all")
        name, densities = named(part.correct), corrected(states)
        for which, value in densities._asdict().items():
            require_shape(f"{name}: {which}", np.where(np.isneginf(value), 0.0, value), (n,))
        silent = not any(getattr(found, block).any() for block in SUMMED)
        if silent and groups:
            same = np.array_equal(densities.all, densities.after_sampling)
            require(same, f"{name}: information says nothing, so that after_sampling must be all of the density")

    def copies() -> None:
        """Descendants of one particle are equal, and an update of one does not affect the others."""
        name, seen = named(part.resample), []
        for between in (alike, np.concatenate([states[:1], states[1:][::-1]])):
            begin()
            corrected(states)
            predicted(states)
            ancestors = np.zeros(n, dtype=np.int64)
            lineages[-1].advance(ancestors)
            called(part.resample, ancestors, repeat=False)
            corrected(between)
            seen.append(corrected(alike).all)
        what = f"{name}: descendants of one particle weigh the same differently"
        require_close(what, seen[0], seen[0][:1].repeat(n), 1e-9)
        what = f"{name}: copies share memory, what one particle sees changes another"
        require_close(what, seen[1][:1], seen[0][:1], 1e-9)

    def checkpoint() -> None:
        begin()
        corrected(states)
        arrays = held()
        after = corrected(states).all
        begin()
        called(part.restore, arrays, repeat=False)
        name = named(part.restore)
        unchanged(arrays, f"{name} does not bring back what arrays() gave")
        require_close(f"{name}: a step afterwards weighs differently", corrected(states).all, after, 1e-12)

    return [life, copies, checkpoint]


def groups_of(sensor: models.Sensor, example: Example) -> list[Any]:
    """The groups of observations of the example's frame."""
    return list(called(sensor.observe, example.frame, example.belief))


class FindingError(Exception):
    """Ends a check; its text is the sentence that the user reads."""


def run(checks: Sequence[Check]) -> list[str]:
    """Sentences of the checks that fail; the others rest on the first one."""
    findings = []
    for number, check in enumerate(checks):
        try:
            check()
        except FindingError as finding:
            findings.append(str(finding))
            if number == 0:
                break
    return list(dict.fromkeys(findings))


def called(method: Callable[..., Any], *args: Any, repeat: bool = True, gives: Sequence[type] = ()) -> Any:
    """A method's result, after checking that it is deterministic and does not change its arguments.

    If types are given, it must be of one of these.
    """
    name, given = named(method), [np.copy(arg) for arg in args if isinstance(arg, np.ndarray)]
    try:
        first = method(*args)
        second = method(*args) if repeat else first
    except Exception as error:
        shapes = ", ".join(str(array.shape) for array in given)
        sentence = f"{name} raised {type(error).__name__} for arguments of shapes {shapes}: {error}"
        raise FindingError(sentence) from error
    now = [arg for arg in args if isinstance(arg, np.ndarray)]
    changed = any(not np.array_equal(a, b, equal_nan=True) for a, b in zip(given, now, strict=True))
    require(not changed, f"{name} changes its arguments in place: it must work on copies")
    pairs = zip(_arrays_in(first), _arrays_in(second), strict=False)
    alike = all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    require(alike, f"{name} returns different numbers for the same arguments: it must not draw or count")
    if gives:
        require_type(name, first, *gives)
    return first


def named(method: Callable[..., Any]) -> str:
    """Class and name of a bound method."""
    return f"{type(getattr(method, '__self__', None)).__name__}.{method.__name__}"


def require(holds: Any, sentence: str) -> None:
    """Ends the check with a sentence unless the condition holds."""
    if not holds:
        raise FindingError(sentence)


def require_type(what: str, value: Any, *allowed: type) -> None:
    """Of one of the allowed types."""
    expected = " or ".join("None" if kind is type(None) else kind.__name__ for kind in allowed)
    require(isinstance(value, allowed), f"{what} returned a {type(value).__name__}, expected {expected}")


def require_shape(what: str, array: Any, *allowed: tuple[int | None, ...]) -> None:
    """An array of one of the allowed shapes, None for any length, without NaN and infinity."""
    require(isinstance(array, np.ndarray), f"{what} is a {type(array).__name__}, expected a NumPy array")
    alike = [shape for shape in allowed if len(shape) == array.ndim]
    fits = any(all(a in (None, b) for a, b in zip(shape, array.shape, strict=True)) for shape in alike)
    expected = " or ".join(str(shape).replace("None", "any") for shape in allowed)
    require(fits, f"{what} has shape {array.shape}, expected {expected}")
    require(array.dtype.kind in "fiub", f"{what} holds {array.dtype}, expected real numbers")
    require(np.isfinite(array).all(), f"{what} holds NaN or infinity, expected finite numbers")


def require_truths(what: str, array: Any, *allowed: tuple[int | None, ...]) -> None:
    """Truth values of one of the allowed shapes."""
    require_shape(what, array, *allowed)
    require(array.dtype == bool, f"{what.split(' for ')[0]} returns {array.dtype}, expected bool")


def require_close(what: str, found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Equal to the tolerance, relative to 1 + |expected|; the sentence names the worst entry."""
    require(found.shape == expected.shape, f"{what}: expected shape {expected.shape}, found {found.shape}")
    error = np.abs(found - expected) / (1.0 + np.abs(expected))
    if not (error > tolerance).any():
        return
    place = tuple(int(i) for i in np.unravel_index(int(np.argmax(error)), error.shape))
    raise FindingError(f"{what}: expected {expected[place]:.9g}, found {found[place]:.9g} at {place}")


def require_covariance(what: str, cov: np.ndarray) -> None:
    """Symmetric and positive semi-definite."""
    skew, scale = np.abs(cov - np.swapaxes(cov, -1, -2)).max(initial=0.0), np.abs(cov).max(initial=0.0)
    require(skew <= 1e-9 * scale, f"{what} is not symmetric, entries differ by {skew:.3g}")
    lowest = float(np.linalg.eigvalsh(cov).min(initial=0.0))
    sentence = f"{what} is not positive semi-definite, its lowest eigenvalue is {lowest:.3g}"
    require(lowest >= -1e-9 * scale, sentence)


def _arrays_in(value: Any) -> list[np.ndarray]:
    if isinstance(value, np.ndarray):
        return [value] if value.dtype.kind in "fiub" else []
    if is_dataclass(value):
        value = tuple(vars(value).values())
    if isinstance(value, tuple | list):
        return [array for item in value for array in _arrays_in(item)]
    return []
