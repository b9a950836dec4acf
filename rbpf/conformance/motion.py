"""Checks of a motion model."""

from functools import partial
from typing import Any

import numpy as np

from rbpf.conformance.arguments import Example
from rbpf.conformance.calls import Check, called, require, require_close, require_shape, require_type
from rbpf.core.models import MotionModel, Transition
from rbpf.lie import LieGroup


def motion_checks(
    model: MotionModel, space: LieGroup, rng: np.random.Generator, example: Example
) -> list[Check]:
    """Shapes, membership of the group, and independence of the particles."""
    state = example.states(space, rng)
    return [
        partial(_check_shapes, model, space, state, example),
        partial(_check_group, model, space, state, example),
        partial(_check_independence, model, state, example),
    ]


def _transition(model: MotionModel, state: np.ndarray, example: Example) -> Any:
    return called(model.transition, state, example.control, example.dt)


def _check_shapes(model: MotionModel, space: LieGroup, state: np.ndarray, example: Example) -> None:
    name, n, d, m = f"{type(model).__name__}.transition", state.shape[0], space.dim, 0
    transition = _transition(model, state, example)
    require_type(name, transition, Transition)
    given = [part is not None for part in (transition.coupling, transition.dynamics, transition.drift)]
    together = all(given) or not any(given)
    require(together, f"{name} must give coupling, dynamics and drift together, or none of them")
    require_shape(f"{name}: mean", transition.mean, (n, space.size))
    if transition.coupling is not None:
        require_shape(f"{name}: coupling", transition.coupling, (n, d, None), (1, d, None))
        m = transition.coupling.shape[-1]
        require_shape(f"{name}: dynamics", transition.dynamics, (n, m, m), (1, m, m))
        require_shape(f"{name}: drift", transition.drift, (n, m), (1, m))
    require_shape(f"{name}: noise_factor", transition.noise_factor, (n, d + m, None), (1, d + m, None))


def _check_group(model: MotionModel, space: LieGroup, state: np.ndarray, example: Example) -> None:
    mean = _transition(model, state, example).mean
    what = f"{type(model).__name__}.transition: mean leaves the group {space!r}, use its compose or retract"
    require_close(what, mean, space.normalise(mean), 1e-9)


def _check_independence(model: MotionModel, state: np.ndarray, example: Example) -> None:
    together = _transition(model, state, example)
    what = f"{type(model).__name__}.transition mixes particles, for one of them alone"
    for i in range(state.shape[0]):
        alone = _transition(model, state[i : i + 1], example)
        for part, whole in vars(together).items():
            if whole is not None:
                row, found = whole[i if whole.shape[0] > 1 else 0], getattr(alone, part)
                require(found is not None, f"{what}, {part} is missing")
                require_close(f"{what}, {part}", found[0], row, 1e-9)
