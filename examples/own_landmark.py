"""A custom landmark parametrisation: bearing-only mapping in the plane by inverse range.

A bearing does not constrain range, which a Gaussian in (x, y) cannot represent. A Gaussian in (bearing,
inverse range) relative to the pose of the first observation can: E06 (12)-(13) in the plane. The anchor pose
is a constant of the record. Store, filter and sensor are unchanged; landmarks that are located well enough
become points.
"""

from types import SimpleNamespace

import numpy as np

from rbpf import SE2, Filter, Landmark, LandmarkMap, ObservationModel, Records, check_model
from rbpf.conformance import Example
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor

STD_BEARING = 0.01  # [rad]
STD_ODOMETRY = np.array([0.002, 0.01, 0.005])  # turn [rad], forward [m], to the left [m]
MEAN_INVERSE, STD_INVERSE = 0.15, 0.1  # prior of a new landmark [1/m]


def _direction(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


class InverseRange(Landmark):
    """(bearing [rad], inverse range [1/m]) in the frame of the constant world_from_anchor (3,)."""

    dim = 2
    constants = 3

    def homogeneous(self, mean, const=None):
        toward = np.einsum("...ij,...j->...i", SE2.rotation(const), _direction(mean[..., 0]))
        inverse = mean[..., 1:]
        return np.concatenate([toward + inverse * SE2.translation(const), inverse], axis=-1)

    def ready(self, records):
        return np.sqrt(records.cov[..., 1, 1]) < 0.03 * records.mean[..., 1]


class Bearing(ObservationModel):
    """z = (bearing,) [rad] of a landmark: an InverseRange (with constant) or a point."""

    dim = 1

    def predict(self, state, landmark=None, const=None, substate=None):
        w = 1.0
        if const is not None:
            landmark, w = np.split(InverseRange().homogeneous(landmark, const), [2], axis=-1)
        away = landmark - w * SE2.translation(state)
        x, y = np.moveaxis(np.einsum("...ji,...j->...i", SE2.rotation(state), away), -1, 0)
        return np.arctan2(y, x)[..., None]

    def residual(self, z, predicted):
        return (z - predicted + np.pi) % (2 * np.pi) - np.pi

    def initialise(self, state, z, cov):
        n, k = state.shape[0], z.shape[0]
        mean = np.stack([z[:, 0], np.full(k, MEAN_INVERSE)], axis=-1)
        variances = np.zeros((k, 2, 2))
        variances[:, 0, 0], variances[:, 1, 1] = cov[:, 0, 0], STD_INVERSE**2
        anchors = np.repeat(state[:, None], k, axis=1)
        return Records(np.tile(mean, (n, 1, 1)), np.tile(variances, (n, 1, 1, 1)), anchors)


def simulate(rng: np.random.Generator, steps: int = 150) -> tuple[list[SimpleNamespace], np.ndarray, np.ndarray]:
    """Frames of a robot on a circle, its true poses (T, 3), and the landmarks (M, 2)."""
    points = 10.0 * rng.uniform(-1.0, 1.0, (30, 2)) + np.array([0.0, 3.0])
    increment = SE2.exp(2 * np.pi / (steps - 1) * np.array([1.0, 3.0, 0.0]))
    pose, frames, poses = SE2.identity(), [], []
    for t in range(steps):
        control = None
        if t:
            pose = SE2.compose(pose, increment)
            measured = SE2.retract(increment, STD_ODOMETRY * rng.normal(size=3))
            control = Odometry(measured, np.diag(STD_ODOMETRY**2))
        z = Bearing().predict(pose, points) + STD_BEARING * rng.normal(size=(len(points), 1))
        seen = np.flatnonzero(np.abs(z[:, 0]) < 1.5)
        cov_z = np.full((seen.size, 1, 1), STD_BEARING**2)
        frames.append(SimpleNamespace(control=control, landmarks=seen, z=z[seen], cov_z=cov_z))
        poses.append(pose)
    return frames, np.array(poses), points


def main() -> dict[str, float]:
    """Checks both classes, runs the filter, and prints the number of located landmarks and their errors."""
    findings = check_model(InverseRange(), SE2) + check_model(Bearing(), SE2, example=Example(landmark=InverseRange()))
    print("check_model:", "; ".join(findings) or "InverseRange and Bearing are sound")
    frames, truth, points = simulate(np.random.default_rng(5))
    point_map = LandmarkMap(SE2)
    sensor = NamedLandmarkSensor(Bearing(), InverseRange())
    filter_ = Filter(OdometryMotion(SE2), sensor, point_map, n=100, rng=np.random.default_rng(0))
    errors, located = [], []
    for frame, true_pose in zip(frames, truth, strict=True):
        estimate = filter_.step(frame, frame.control).estimate
        errors.append(np.linalg.norm((estimate.mean - true_pose)[1:]))
        ready = point_map.ready(filter_.particles.weights)
        point_map.promote(ready)
        located += ready.tolist()
    means, _ = filter_.belief().moments(located)
    distances = np.linalg.norm(means - points[located], axis=1)
    figures = {
        "findings": len(findings),
        "located": len(located),
        "map": float(np.median(distances)),
        "path": float(np.mean(errors)),
    }
    print(f"{len(located)} of {point_map.ids.size} landmarks became points, median error {figures['map']:.2f} m")
    print(f"mean position error of the robot: {figures['path']:.2f} m after a way of 19 m")
    return figures


if __name__ == "__main__":
    main()
