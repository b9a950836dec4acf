"""Checks of how an observation model starts landmarks."""

import numpy as np

from rbpf.conformance.arguments import Scene
from rbpf.conformance.calls import (
    called,
    named,
    require,
    require_close,
    require_covariance,
    require_shape,
    require_type,
)
from rbpf.core.models import Landmark, ObservationModel, Records

ROUND_TRIP_TOLERANCE = 1e-7
STD = 1e-3
"""Of the measurement noise that first estimates are made with, in the measurement's units."""


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
    _check_records(name, records, scene, landmark)
    if records.log_weights is None:
        distance = np.abs(model.residual(z, model.predict(scene.state, records.mean, records.const))).max()
        what = f"{name} gives estimates whose prediction is {distance:.3g} away from z"
        require(distance <= STD, f"{what}, expected less than its standard deviation {STD}")


def _check_records(name: str, records: Records, scene: Scene, landmark: Landmark | None) -> None:
    assert scene.landmark is not None
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
