"""Says in words what is wrong with a user's model, before a filter is built on it.

Every check calls the model as the filter does, on random arguments or on those of an `Example`, and compares
the answer with what `rbpf.core.models` promises: shapes, numeric derivatives, the compiled twin, round trips.
"""

import numpy as np

from rbpf.conformance.models import groups_of, landmark_checks, likelihood_checks, motion_checks, sensor_checks
from rbpf.conformance.observation import observation_checks
from rbpf.conformance.trial import Example, Scene, run
from rbpf.core.models import Landmark, Likelihood, MotionModel, ObservationModel, Sensor
from rbpf.errors import InputError
from rbpf.lie import LieGroup

__all__ = ["Example", "check_model", "require_sound"]


def check_model(
    model: object, space: LieGroup | None = None, rng: np.random.Generator | None = None, example: Example | None = None
) -> list[str]:
    """What is wrong with a MotionModel, ObservationModel, Landmark, Likelihood or Sensor.

    Args:
        model: an object of a class derived from one of these.
        space: group of the state; by default `model.space`.
        rng: draws the arguments; by default always the same ones.
        example: arguments that replace random ones; a Sensor needs its frame and belief.

    Returns one sentence per finding, none for a sound model: class, method, what was expected and found. Raises InputError:
    the object is of none of these classes, or cannot be tried without more than was given.
    """
    rng, example = rng or np.random.default_rng(0), example or Example()
    space = space or getattr(model, "space", None)
    if isinstance(model, Sensor):
        found = run(sensor_checks(model, example))
        if found or example.belief is None:
            return found
        # Of a sound sensor, the models and likelihoods of what it observes.
        observed: dict[str, None] = {}
        for group in groups_of(model, example):
            for part in (group.model, group.likelihood):
                if part is not None:
                    findings = check_model(part, example.belief.prior.space, rng, example)
                    observed.update(dict.fromkeys(findings))
        return list(observed)
    name = type(model).__name__
    if not isinstance(model, MotionModel | ObservationModel | Landmark | Likelihood):
        raise InputError(
            f"check_model tries a MotionModel, ObservationModel, Landmark, Likelihood or Sensor; a {name} is none of these"
        )
    with np.errstate(all="ignore"):
        if isinstance(model, Likelihood):
            return run(likelihood_checks(model, rng))
        if isinstance(model, Landmark):
            return run(landmark_checks(model, space, rng, example))
        if space is None:
            raise InputError(f"{name} has no attribute space: tell check_model the group of the state")
        if isinstance(model, MotionModel):
            return run(motion_checks(model, space, rng, example))
        return run(observation_checks(model, Scene.draw(model, space, rng, example), example.landmark))


def require_sound(
    model: object, space: LieGroup | None = None, rng: np.random.Generator | None = None, example: Example | None = None
) -> None:
    """As `check_model`, but raises an InputError that holds all findings."""
    findings = check_model(model, space, rng, example)
    if findings:
        raise InputError("; ".join(findings))
