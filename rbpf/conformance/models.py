"""Checks of motion models, landmarks, likelihoods and sensors."""

from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.conformance.trial import (
    LANDMARKS,
    PARTICLES,
    Check,
    Example,
    FindingError,
    called,
    named,
    random_constants,
    require,
    require_close,
    require_covariance,
    require_shape,
    require_truths,
    require_type,
)
from rbpf.core.genealogy import Lineage
from rbpf.core.models import (
    NEW,
    Conditional,
    Landmark,
    Likelihood,
    LogDensities,
    MotionModel,
    NewLandmarks,
    Observations,
    Part,
    Records,
    Sensor,
    Transition,
    draws,
)
from rbpf.core.particles import SUMMED, Information, Prior
from rbpf.errors import InputError
from rbpf.kernels.gate import is_inlier, log_likelihood
from rbpf.lie import LieGroup

KERNEL_IDS = (-1, 0, 1, 2)
MASS_TOLERANCE = 5e-3
FAR = 1000.0
"""Standard deviations up to which a density is integrated; out there only a uniform floor is left of it."""
STD = 0.1
"""Of random estimates of landmarks, in the parametrisation's units."""


def motion_checks(model: MotionModel, space: LieGroup, rng: np.random.Generator, example: Example) -> list[Check]:
    """Shapes, membership of the group, and independence of the particles."""
    name, states = named(model.transition), example.states(space, rng)

    def drawn() -> None:
        """From the generator that is given, and from nothing else."""
        nonlocal states
        name = named(model.sample)
        if draws(model):
            twice = [
                called(model.sample, states, example.control, example.dt, np.random.default_rng(1), repeat=False)
                for _ in range(2)
            ]
            require_shape(f"{name}: states", twice[0], states.shape)
            same = np.array_equal(*twice)
            require(same, f"{name} draws from something else than the generator that it is given")
            what = f"{name} leaves the group {space!r}, use its compose or retract"
            require_close(what, twice[0], space.normalise(twice[0]), 1e-9)
            states = twice[0]

    def transition(state: np.ndarray) -> Any:
        return called(model.transition, state, example.control, example.dt)

    def shapes() -> None:
        drawn()
        n, d, m, found = states.shape[0], space.dim, 0, transition(states)
        require_type(name, found, Transition)
        given = [part is not None for part in (found.coupling, found.dynamics, found.drift)]
        together = all(given) or not any(given)
        require(together, f"{name} must give coupling, dynamics and drift together, or none of them")
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


def landmark_checks(
    landmark: Landmark, space: LieGroup | None, rng: np.random.Generator, example: Example
) -> list[Check]:
    """Sizes, world points, readiness and promotion."""

    def tried() -> Records:
        if example.records is not None:
            return example.records
        lead, dim = (PARTICLES, LANDMARKS), landmark.dim
        inner = lead if landmark.components == 1 else (*lead, landmark.components)
        factor = STD * rng.normal(size=(*inner, dim, dim + 1))
        log_weights = np.full(inner, -np.log(landmark.components)) if landmark.components > 1 else None
        const = random_constants(landmark, space, rng, lead)
        cov = factor @ np.swapaxes(factor, -1, -2)
        return Records(rng.normal(size=(*inner, dim)), cov, const, log_weights)

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
        promoted, lead = called(landmark.promote, records), records.mean.shape[:2]
        require_type(name, promoted, Records)
        require_shape(f"{name}: mean", promoted.mean, (*lead, 2), (*lead, 3))
        size = promoted.mean.shape[-1]
        require_shape(f"{name}: cov", promoted.cov, (*lead, size, size))
        require_covariance(f"{name}: cov", promoted.cov)

    return [world_points, readiness, promotion]


def likelihood_checks(likelihood: Likelihood, rng: np.random.Generator) -> list[Check]:
    """Shapes, mass, and the compiled twin."""
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

    def compiled_twin() -> None:
        name, kernel_id, params = type(likelihood).__name__, likelihood.kernel_id, likelihood.params
        require(kernel_id in KERNEL_IDS, f"{name}.kernel_id is {kernel_id}, expected one of {KERNEL_IDS}")
        if kernel_id < 0:
            return
        plain = isinstance(params, np.ndarray) and params.dtype == float and params.ndim == 1
        require(plain, f"{name}.params is not one axis of float64 numbers")
        nu, cov = innovations(2)
        chol = gaussian.cholesky(cov)
        squared = np.square(gaussian.solve_lower(chol, nu)).sum(axis=-1)
        scale = np.exp(-0.5 * gaussian.log_det(chol))
        twin, inside = np.empty_like(squared), np.empty_like(squared, dtype=bool)
        for at in np.ndindex(squared.shape):
            lane = (kernel_id, params, squared[at], scale[at], 2)
            twin[at], inside[at] = log_likelihood(*lane), is_inlier(*lane)
        what = f"{name}.log_density differs from its compiled kernel {kernel_id}"
        require_close(what, log_density(nu, cov), twin, 1e-9)
        same = np.array_equal(inlier(nu, cov), inside)
        require(same, f"{name}.inlier differs from its compiled kernel {kernel_id}")

    return [shapes, mass, compiled_twin]


def sensor_checks(sensor: Sensor, example: Example) -> list[Check]:
    """What it observes, then what it starts."""
    belief = example.belief
    if belief is None:
        name = type(sensor).__name__
        raise InputError(f"{name} is tried on a frame and a belief: give Example(frame=…, belief=…)")
    n = belief.log_weights.size

    def measurements(name: str, group: Observations | NewLandmarks) -> None:
        k, p, model = group.z.shape[0], group.model.dim, type(group.model).__name__
        require_shape(f"{name}: z of {model}", group.z, (None, p))
        require_shape(f"{name}: cov of {model}", group.cov, (k, p, p))
        require_covariance(f"{name}: cov of {model}", group.cov)

    def observed() -> None:
        name = named(sensor.observe)
        for group in groups_of(sensor, example):
            require_type(f"{name}, for a group,", group, Observations)
            if group.data is not None:
                continue
            measurements(name, group)
            if Part.LANDMARK not in group.model.reads:
                continue
            k, ids = group.z.shape[0], group.ids
            if ids is None:
                raise FindingError(f"{name} gives no ids, but {type(group.model).__name__} reads a landmark")
            require_shape(f"{name}: ids", ids, (k,), (n, k))
            require(ids.dtype.kind == "i", f"{name}: ids are {ids.dtype}, expected integers")
            unknown = np.setdiff1d(ids[ids >= 0], belief.map.ids).tolist()
            require(not unknown, f"{name} names landmarks {unknown}, which the map does not hold")
            known = (ids >= NEW).all()
            require(known, f"{name}: ids below {NEW} mean nothing, expected a landmark, NULL or NEW")

    def started() -> None:
        name, groups = named(sensor.new_landmarks), groups_of(sensor, example)
        for new_landmarks in called(sensor.new_landmarks, example.frame, belief, groups, repeat=False):
            require_type(f"{name}, for a group,", new_landmarks, NewLandmarks)
            measurements(name, new_landmarks)
            k = new_landmarks.z.shape[0]
            if new_landmarks.mask is not None:
                require_shape(f"{name}: mask", new_landmarks.mask, (n, k))
            if new_landmarks.ids is not None:
                require_shape(f"{name}: ids", new_landmarks.ids, (k,))
                taken = new_landmarks.ids[belief.map.holds(new_landmarks.ids)].tolist()
                require(not taken, f"{name} starts landmarks {taken}, which the map holds already")

    return [observed, started]


def conditional_checks(part: Conditional, space: LieGroup, rng: np.random.Generator, example: Example) -> list[Check]:
    """A few steps of what is marginalised: shapes, what a prediction may change, copies, and the checkpoint."""
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
        transition = example.transition or Transition(state, np.zeros((1, d, 1)))
        prior = called(part.predict, transition, space, example.dt)
        require_type(named(part.predict), prior, Prior, type(None))
        return prior or Prior(space, transition.mean, np.zeros((1, d)), transition.noise_factor[:, :d])

    def corrected(state: np.ndarray) -> LogDensities:
        prior = predicted(state)
        found = called(part.correct, state, space.local(prior.base, state), groups, repeat=False)
        require_type(named(part.correct), found, LogDensities)
        return found

    def life() -> None:
        require(
            isinstance(part.supplies, Part), f"{type(part).__name__}.supplies is {part.supplies!r}, expected a Part"
        )
        begin()
        before = held()
        prior = predicted(states)
        unchanged(before, f"{named(part.predict)} changes what is held: a step may be looked at and not be taken")
        name, found = named(part.information), Information.zeros(n, d)
        if groups:
            found = called(part.information, states, groups, prior)
        require_type(name, found, Information)
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
        """Descendants of one particle are alike, and what one of them sees is nothing to the others."""
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
        require_close(
            f"{name}: descendants of one particle weigh the same differently", seen[0], seen[0][:1].repeat(n), 1e-9
        )
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


def groups_of(sensor: Sensor, example: Example) -> list[Any]:
    """The groups of observations of the example's frame."""
    return list(called(sensor.observe, example.frame, example.belief))
