"""Checks a user's model, and describes what is wrong with it, before a filter is built on it.

Every check calls the model as the filter does, on random arguments or on those of an `Example`, and compares
the answer with what `rbpf.core.models` promises: shapes, numeric derivatives, the compiled twin, round trips.
"""

from dataclasses import replace

import numpy as np

from rbpf.conformance import checks
from rbpf.conformance.trial import Example, Scene
from rbpf.core.models import Conditional, Landmark, Likelihood, MotionModel, ObservationModel, Sensor
from rbpf.errors import InputError
from rbpf.lie import LieGroup

__all__ = ["Example", "check_model"]


def check_model(
    model: object, space: LieGroup | None = None, rng: np.random.Generator | None = None, example: Example | None = None
) -> list[str]:
    """Checks a MotionModel, ObservationModel, Landmark, Likelihood, Sensor or Conditional.

    Args:
        model: an object of a class derived from one of these. A Conditional is re-initialised.
        space: group of the state; by default `model.space`.
        rng: draws the arguments; by default with a fixed seed.
        example: arguments that replace random ones; a Sensor needs its frame and belief, a Conditional its groups.

    Returns one sentence per finding, none for a sound model: class, method, what was expected and found. Raises InputError:
    the object is of none of these classes, or cannot be checked without further arguments.
    """
    rng, example = rng or np.random.default_rng(0), example or Example()
    space = space or getattr(model, "space", None)
    if isinstance(model, Sensor):
        return sensor_findings(model, rng, example)
    name = type(model).__name__
    if not isinstance(model, MotionModel | ObservationModel | Landmark | Likelihood | Conditional):
        raise InputError(
            f"check_model tries a motion or observation model, Landmark, Likelihood, Sensor or Conditional, not a {name}"
        )
    with np.errstate(all="ignore"):
        if isinstance(model, Likelihood):
            return checks.run(checks.likelihood_checks(model, rng))
        if isinstance(model, Landmark):
            return checks.run(checks.landmark_checks(model, space, rng, example))
        if space is None:
            raise InputError(f"{name} has no attribute space: tell check_model the group of the state")
        if isinstance(model, Conditional):
            return checks.run(checks.conditional_checks(model, space, rng, example))
        if isinstance(model, MotionModel):
            return checks.run(checks.motion_checks(model, space, rng, example))
        return checks.run(checks.observation_checks(model, Scene.draw(model, space, rng, example), example.landmark))


def sensor_findings(sensor: Sensor, rng: np.random.Generator, example: Example) -> list[str]:
    """Findings of a sensor; if it is sound, of the models, landmarks and likelihoods that it uses."""
    belief = example.belief
    if belief is not None and belief.landmarks != sensor.part:
        example = replace(example, belief=replace(belief, landmarks=sensor.part))
    found = checks.run(checks.sensor_checks(sensor, example))
    if found or example.belief is None:
        return found
    space, findings, groups = example.belief.prior.space, list[str](), checks.groups_of(sensor, example)
    for group in groups:
        tried = example
        if group.data is not None:
            continue
        if group.ids is not None and (group.ids >= 0).any():
            # The model's landmark is tested on the map's landmarks.
            known = np.unique(group.ids[group.ids >= 0])
            landmark = example.belief.map.landmark_of(int(known[0]))
            records = example.belief.read(known[example.belief.map.are(known, landmark)])
            if records.log_weights is None:
                tried = replace(example, state=example.belief.state, landmark=landmark, records=records)
            else:
                tried = replace(example, landmark=landmark, records=None)
        findings += check_model(group.model, space, rng, tried)
        if group.likelihood is not None:
            findings += check_model(group.likelihood, space, rng, tried)
    for new in sensor.new_landmarks(example.frame, example.belief, groups):
        tried = replace(example, landmark=new.landmark, records=None)
        findings += check_model(new.landmark, space, rng, tried) + check_model(new.model, space, rng, tried)
    return list(dict.fromkeys(findings))
