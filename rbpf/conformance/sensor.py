"""Checks of a sensor on a frame and a belief."""

from functools import partial
from typing import Any

import numpy as np

from rbpf.conformance.arguments import Example
from rbpf.conformance.calls import (
    Check,
    FindingError,
    called,
    named,
    require,
    require_covariance,
    require_shape,
    require_type,
)
from rbpf.core.models import NEW, NewLandmarks, Observations, Part, Sensor
from rbpf.errors import InputError


def sensor_checks(sensor: Sensor, example: Example) -> list[Check]:
    """What it observes, then what it starts."""
    if example.belief is None:
        name = type(sensor).__name__
        raise InputError(f"{name} is tried on a frame and a belief: give Example(frame=…, belief=…)")
    return [partial(_check_observe, sensor, example), partial(_check_new_landmarks, sensor, example)]


def observe(sensor: Sensor, example: Example) -> list[Any]:
    """The groups of the example's frame."""
    return list(called(sensor.observe, example.frame, example.belief))


def _check_observe(sensor: Sensor, example: Example) -> None:
    name = named(sensor.observe)
    for group in observe(sensor, example):
        require_type(f"{name}, for a group,", group, Observations)
        _check_measurements(name, group)
        _check_ids(name, group, example.belief)


def _check_measurements(name: str, group: Any) -> None:
    k, p, model = group.z.shape[0], group.model.dim, type(group.model).__name__
    require_shape(f"{name}: z of {model}", group.z, (None, p))
    require_shape(f"{name}: cov of {model}", group.cov, (k, p, p))
    require_covariance(f"{name}: cov of {model}", group.cov)


def _check_ids(name: str, group: Observations, belief: Any) -> None:
    if Part.LANDMARK not in group.model.reads:
        return
    n, k, ids = belief.log_weights.size, group.z.shape[0], group.ids
    if ids is None:
        raise FindingError(f"{name} gives no ids, but {type(group.model).__name__} reads a landmark")
    require_shape(f"{name}: ids", ids, (k,), (n, k))
    require(ids.dtype.kind == "i", f"{name}: ids are {ids.dtype}, expected integers")
    unknown = np.setdiff1d(ids[ids >= 0], belief.map.ids)
    require(unknown.size == 0, f"{name} names landmarks {unknown.tolist()}, which the map does not hold")
    require((ids >= NEW).all(), f"{name}: ids below {NEW} mean nothing, expected a landmark, NULL or NEW")


def _check_new_landmarks(sensor: Sensor, example: Example) -> None:
    name, n = named(sensor.new_landmarks), example.belief.log_weights.size
    observed = observe(sensor, example)
    for new_landmarks in called(sensor.new_landmarks, example.frame, example.belief, observed, repeat=False):
        require_type(f"{name}, for a group,", new_landmarks, NewLandmarks)
        _check_measurements(name, new_landmarks)
        k, facts = new_landmarks.z.shape[0], len(new_landmarks.facts)
        if new_landmarks.mask is not None:
            require_shape(f"{name}: mask", new_landmarks.mask, (n, k))
        require(facts in (0, k), f"{name} gives {facts} facts for {k} landmarks, expected one each or none")
        if new_landmarks.ids is not None:
            require_shape(f"{name}: ids", new_landmarks.ids, (k,))
            taken = new_landmarks.ids[example.belief.map.holds(new_landmarks.ids)]
            require(taken.size == 0, f"{name} starts landmarks {taken.tolist()}, which the map holds already")
