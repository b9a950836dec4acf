"""Checks of a landmark's parametrisation."""

import numpy as np

from rbpf.conformance.arguments import LANDMARKS, PARTICLES, Example, random_constants
from rbpf.conformance.calls import (
    Check,
    called,
    named,
    require,
    require_close,
    require_covariance,
    require_shape,
    require_type,
)
from rbpf.core.models import Landmark, Records
from rbpf.lie import LieGroup

STD = 0.1
"""Of random estimates, in the parametrisation's units."""


def landmark_checks(
    landmark: Landmark, space: LieGroup | None, rng: np.random.Generator, example: Example
) -> list[Check]:
    """Sizes, world points, readiness and promotion."""

    def records() -> Records:
        return example.records or _random_records(landmark, space, rng)

    def world_points() -> None:
        _check_sizes(landmark)
        _check_homogeneous(landmark, records())

    return [
        world_points,
        lambda: _check_ready(landmark, records()),
        lambda: _check_promote(landmark, records()),
    ]


def _check_sizes(landmark: Landmark) -> None:
    for name, least in (("dim", 1), ("constants", 0), ("components", 1)):
        value, what = getattr(landmark, name, None), f"{type(landmark).__name__}.{name}"
        fits = isinstance(value, int) and value >= least
        require(fits, f"{what} is {value!r}, expected an integer of at least {least}")


def _random_records(landmark: Landmark, space: LieGroup | None, rng: np.random.Generator) -> Records:
    lead, dim = (PARTICLES, LANDMARKS), landmark.dim
    inner = lead if landmark.components == 1 else (*lead, landmark.components)
    factor = STD * rng.normal(size=(*inner, dim, dim + 1))
    log_weights = np.full(inner, -np.log(landmark.components)) if landmark.components > 1 else None
    const = random_constants(landmark, space, rng, lead)
    return Records(rng.normal(size=(*inner, dim)), factor @ np.swapaxes(factor, -1, -2), const, log_weights)


def _check_homogeneous(landmark: Landmark, records: Records) -> None:
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


def _check_ready(landmark: Landmark, records: Records) -> None:
    ready = called(landmark.ready, records)
    require_shape(named(landmark.ready), ready, records.mean.shape[:2])
    require(ready.dtype == bool, f"{named(landmark.ready)} returns {ready.dtype}, expected bool")


def _check_promote(landmark: Landmark, records: Records) -> None:
    promoted = called(landmark.promote, records)
    name, lead = named(landmark.promote), records.mean.shape[:2]
    require_type(name, promoted, Records)
    require_shape(f"{name}: mean", promoted.mean, (*lead, 2), (*lead, 3))
    size = promoted.mean.shape[-1]
    require_shape(f"{name}: cov", promoted.cov, (*lead, size, size))
    require_covariance(f"{name}: cov", promoted.cov)
