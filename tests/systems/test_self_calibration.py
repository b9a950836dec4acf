"""A camera whose focal lengths and distortion are members of the joint map: found while running, and honest about it."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO
from rbpf.core.linearisation import numeric_jacobians
from rbpf.core.models import Part
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_features
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, CameraRay
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.slam import MonoSlam
from tests.systems.mono_logs import desk, without_known

ONLINE = MonoConfig(calibrate="online", particles=30, settled_frames=15)
BENT = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.2, 0.05, 1e-3, -2e-3, 0.01))
FISHEYE = Pinhole(640, 480, 300.0, 310.0, 320.0, 240.0, (0.02, -0.01, 0.002, 0.001), "equidistant")


@pytest.mark.parametrize("camera", [BENT, FISHEYE], ids=["radial-tangential", "equidistant"])
def test_slopes_by_the_calibration(camera):
    """Of what is seen, of what is started, and that the linear model is the tuned camera's to the second order."""
    rng = np.random.default_rng(0)
    point, state = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (6, 3)), SE3.exp(0.1 * rng.normal(size=6))
    about, tuned = np.zeros(10), np.concatenate([rng.normal(size=6), [0.02, 0.01, 0.01, -0.02]])
    model = CameraPoint(camera, about=about)
    slope = model.jacobians(state, point, None, about).substate
    numeric = numeric_jacobians(model, SE3, state, point, None, np.tile(about, (6, 1)), frozenset({Part.SUBSTATE}))
    np.testing.assert_allclose(slope, numeric.substate, atol=1e-4)
    seen = CameraPoint(camera.tuned(tuned[6:])).predict(state, point)
    predicted = model.predict(state, point, None, tuned)
    assert np.abs(predicted - seen).max() < 0.05 * np.abs(seen - model.predict(state, point)).max()
    ray, step = CameraRay(camera, about=about), 1e-6
    for k in range(4):
        one, other = (camera.tuned(sign * step * np.eye(4)[k]).unproject(seen) for sign in (1.0, -1.0))
        np.testing.assert_allclose(ray.new_by_substate(seen)[:, :2, 6 + k], (one - other) / (2 * step), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_a_focal_length_that_is_too_long_is_found(known):
    """By a camera over a desk; it is nearer than it was, by more than chance, and within what is stated."""
    log = desk(3, frames=60, measurements=20)
    log = replace(log if known else without_known(log), camera=MONO.tuned(np.array([0.05, 0.05, 0.0, 0.0])))
    run = filter_features(log, ONLINE)
    camera, std = run.system.hand_over.calibration(run.system.filter)
    assert abs(np.log(camera.fx / MONO.fx)) < min(3.0 * std[0], 0.02)
    assert std[0] < 0.01
    entries = run.system.summary(run.log)["calibration"]
    assert entries["fx"] == camera.fx and entries["std_fx"] == pytest.approx(camera.fx * std[0])
    assert f"fx: {float(camera.fx)!r}" in run.system.files(run.log)["camera.yaml"]
    assert run.system.measurements("desk", run.log).camera == camera


@pytest.mark.parametrize(
    "options", [{"map": "particles"}, {"known": "points"}, {"lag": 5}], ids=["particles", "points", "lag"]
)
def test_what_is_refused(options):
    with pytest.raises(InputError, match="calibrate=online holds the camera in a joint map"):
        MonoSlam(MONO, replace(ONLINE, **options))
