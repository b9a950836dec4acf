"""GTSAM's factors of a camera's sightings, and of a camera that keeps its velocity.

    sighting:  project(T⁻¹ l) − z ~ N(0, R)
    velocity:  Log(T_{t−1}⁻¹ T_t) − δ v_{t−1} = w₁,  v_t − v_{t−1} = w₂,  (w₁, w₂) ~ N(0, Q), E06 (4)–(5)

GTSAM's own projection factors are taken where they are exactly our camera: Cal3DS2 has no k₃. Factors written in
Python are evaluated all at once and handed out one by one, which makes them nearly as fast as GTSAM's.
"""

from collections.abc import Callable
from typing import Any, final

import gtsam
import numpy as np

from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.validation.gtsam.camera_data import Sightings, in_camera
from rbpf.validation.gtsam.solvers import huber, noise

LANDMARK, VELOCITY = "l", "v"
"""Letters of the keys."""

Evaluation = tuple[Array, list[Array]]
"""Residuals (K, p), and per variable of a factor its slopes (K, p, d)."""
Maker = Callable[[int, Any, int, int], Any]
"""Row, noise, key of the pose and of the landmark to a factor."""


def path_of(values: Any) -> Array:
    """Poses (P, 7), in the order of their keys."""
    rows = gtsam.utilities.extractPose3(values)
    matrices = np.concatenate([rows[:, :9].reshape(-1, 3, 3), rows[:, 9:, None]], axis=-1)
    return SE3.from_matrix(matrices)


def points_of(values: Any) -> Array:
    """Landmarks (L, 3), in the order of their keys."""
    return np.asarray(gtsam.utilities.extractVectors(values, LANDMARK))


def velocities_of(values: Any) -> Array:
    """Velocities (P, 6), in the order of their keys."""
    return np.asarray(gtsam.utilities.extractVectors(values, VELOCITY))


@final
class Together:
    """Residuals of many factors, evaluated when the first of them is asked for and kept for the others.

    GTSAM hands every factor the same object as long as Python holds it, as the loops of `solvers` do; an
    optimiser that changes its values in place would be shown old residuals.

    Args:
        evaluate: values to all residuals and slopes.
    """

    def __init__(self, evaluate: Callable[[Any], Evaluation]) -> None:
        self._evaluate = evaluate
        self._held: Any = None
        self._found: Evaluation = np.empty(0), []

    def factor(self, row: int, keys: list[int], model: Any) -> Any:
        """The factor of one row."""

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            if values is not self._held:
                self._held, self._found = values, self._evaluate(values)
            residuals, slopes = self._found
            if jacobians is not None:
                for place, slope in enumerate(slopes):
                    jacobians[place] = slope[row]
            return residuals[row]

        return gtsam.CustomFactor(model, keys, error)


def sighting_factors(
    table: Sightings, pose_keys: list[int], point_keys: list[int], robust: float | None
) -> Any:
    """One factor per row.

    Args:
        table: the sightings.
        pose_keys: (T,) of the frames.
        point_keys: (L,) of the landmarks.
        robust: Huber's threshold; None is Gaussian.
    """
    make, order = _maker(table, pose_keys)
    models, graph = dict[bytes, Any](), gtsam.NonlinearFactorGraph()
    for row, (step, index) in enumerate(zip(table.steps.tolist(), table.index.tolist(), strict=True)):
        code = table.cov_z[row].tobytes()
        if code not in models:
            models[code] = huber(noise(table.cov_z[row][np.ix_(order, order)]), robust)
        graph.push_back(make(row, models[code], pose_keys[step], point_keys[index]))
    return graph


def _maker(table: Sightings, pose_keys: list[int]) -> tuple[Maker, list[int]]:
    # A factor's residual is ours[order].
    camera = table.camera
    if isinstance(camera, RectifiedStereo):
        return _stereo_maker(table.z, camera), [0, 2, 1]
    if camera.distortion_model == "equidistant" or camera.distortion[4] == 0.0:
        return _mono_maker(table.z, camera), [0, 1]
    slots = np.unique(pose_keys, return_inverse=True)[1]
    together = Together(lambda values: evaluate_sightings(table, path_of(values)[slots], points_of(values)))
    return lambda row, model, pose, point: together.factor(row, [pose, point], model), [0, 1]


def _mono_maker(z: Array, camera: Pinhole) -> Maker:
    intrinsics = camera.fx, camera.fy, 0.0, camera.cx, camera.cy
    if camera.distortion_model == "equidistant":
        fisheye = gtsam.Cal3Fisheye(*intrinsics, *camera.distortion)
        return lambda row, model, pose, point: gtsam.GenericProjectionFactorCal3Fisheye(
            z[row], model, pose, point, fisheye
        )
    if camera.lens.is_identity:
        plain = gtsam.Cal3_S2(*intrinsics)
        return lambda row, model, pose, point: gtsam.GenericProjectionFactorCal3_S2(
            z[row], model, pose, point, plain
        )
    bent = gtsam.Cal3DS2(*intrinsics, *camera.distortion[:4])
    return lambda row, model, pose, point: gtsam.GenericProjectionFactorCal3DS2(
        z[row], model, pose, point, bent
    )


def _stereo_maker(z: Array, pair: RectifiedStereo) -> Maker:
    camera = pair.camera
    both = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, pair.baseline_m)
    return lambda row, model, pose, point: gtsam.GenericStereoFactor3D(
        gtsam.StereoPoint2(z[row, 0], z[row, 2], z[row, 1]), model, pose, point, both
    )


def evaluate_sightings(table: Sightings, path: Array, points: Array) -> Evaluation:
    """Residuals (K, p) and their slopes by the pose (K, p, 6) and the landmark (K, p, 3).

    A landmark behind its camera costs a constant, as in GTSAM's own factors.
    """
    place = in_camera(table, path, points)
    front = place[:, 2] > 0
    place = np.where(front[:, None], place, [0.0, 0.0, 1.0])
    pinhole = table.camera.camera if isinstance(table.camera, RectifiedStereo) else table.camera
    residuals = np.where(front[:, None], table.camera.project(place) - table.z, 2 * pinhole.fx)
    slope = np.where(front[:, None, None], table.camera.jacobian(place), 0.0)
    # c = T⁻¹ l moves by c × ω − v: the rows of the slope s turn with s · (c × ω) = (s × c) · ω.
    by_pose = np.concatenate([np.cross(slope, place[:, None]), -slope], axis=-1)
    return residuals, [by_pose, slope @ SE3.rotation(path[table.steps]).mT]


def velocity_factors(dt: Array, std: Array, pose_keys: list[int], velocity_keys: list[int]) -> Any:
    """One factor per pair of consecutive times: E06 (5) in the right chart.

    Args:
        dt: (P-1,) steps, positive [s].
        std: (6,) of the white-noise acceleration [rad, m / s / sqrt(s)].
        pose_keys: (P,).
        velocity_keys: (P,).
    """
    together = Together(lambda values: evaluate_velocities(dt, std, path_of(values), velocities_of(values)))
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(12)
    for row in range(len(dt)):
        keys = [*pose_keys[row : row + 2], *velocity_keys[row : row + 2]]
        graph.push_back(together.factor(row, keys, unit))
    return graph


def evaluate_velocities(dt: Array, std: Array, path: Array, velocities: Array) -> Evaluation:
    """Whitened residuals (P-1, 12) and their slopes (P-1, 12, 6) by both poses and both velocities.

    With Q of E06 (5), w₁ − δ/2 w₂ and w₂ are independent, with variances δ³/12 Σ and δ Σ.
    """
    xi = SE3.local(path[:-1], path[1:])
    w1, w2 = xi - dt[:, None] * velocities[:-1], np.diff(velocities, axis=0)
    half = 0.5 * dt[:, None]
    scale1, scale2 = (1 / (s[:, None] * std) for s in (np.sqrt(dt**3 / 12), np.sqrt(dt)))
    residuals = np.concatenate([scale1 * (w1 - half * w2), scale2 * w2], axis=-1)
    unit, none = np.broadcast_to(np.eye(6), (len(dt), 6, 6)), np.zeros((len(dt), 6, 6))
    tops = [-SE3.left_jacobian_inverse(xi), SE3.right_jacobian_inverse(xi), -half[..., None] * unit]
    lows = [none, none, -unit, unit]
    slopes = [
        np.concatenate([scale1[..., None] * top, scale2[..., None] * low], axis=1)
        for top, low in zip([*tops, tops[2]], lows, strict=True)
    ]
    return residuals, slopes
