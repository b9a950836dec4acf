"""A custom sensor in one class: a robot observes equal lamps by bearing and apparent brightness.

Brightness decreases with the squared distance, so that bearing and log-brightness together locate a lamp.
`LampSensor` is all that a user writes; the measurement-conditioned proposal (FastSLAM 2.0), the map and the
derivatives are provided by the framework.
"""

from types import SimpleNamespace

import numpy as np

from rbpf import SE2, Filter, LandmarkMap, ObservationModel, Point, check_model
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor

STD = np.array([0.02, 0.1])  # bearing [rad], log-brightness
STD_ODOMETRY = np.array([0.01, 0.03, 0.01])  # turn [rad], forward [m], to the left [m]


class LampSensor(ObservationModel):
    """z = (bearing [rad], log-brightness) of a lamp (x, y) whose brightness is 1 at a distance of 1 m."""

    dim = 2

    def predict(self, state, landmark=None, const=None, substate=None):
        x, y = np.moveaxis(SE2.inverse_transform(state, landmark), -1, 0)
        return np.stack([np.arctan2(y, x), -np.log(x * x + y * y)], axis=-1)

    def residual(self, z, predicted):
        difference = z - predicted
        difference[..., 0] = (difference[..., 0] + np.pi) % (2 * np.pi) - np.pi
        return difference

    def invert(self, state, z):
        direction = np.stack([np.cos(z[..., 0]), np.sin(z[..., 0])], axis=-1)
        return SE2.transform(state, np.exp(-0.5 * z[..., 1:]) * direction)


def simulate(rng: np.random.Generator, steps: int = 200) -> tuple[list[SimpleNamespace], np.ndarray, np.ndarray]:
    """Frames of a robot that drives two laps of a circle, its true poses (T, 3), and the lamps (M, 2)."""
    lamps = rng.uniform([-8.0, -4.0], [8.0, 12.0], (40, 2))
    increment = SE2.exp(4 * np.pi / (steps - 1) * np.array([1.0, 4.0, 0.0]))
    model, pose, frames, poses = LampSensor(), SE2.identity(), [], []
    for t in range(steps):
        control = None
        if t:
            pose = SE2.compose(pose, increment)
            measured = SE2.retract(increment, STD_ODOMETRY * rng.normal(size=3))
            control = Odometry(measured, np.diag(STD_ODOMETRY**2))
        seen = np.flatnonzero(np.hypot(*(lamps - pose[1:]).T) < 5.0)
        z = model.predict(pose, lamps[seen]) + STD * rng.normal(size=(seen.size, 2))
        cov_z = np.repeat(np.diag(STD**2)[None], seen.size, axis=0)
        frames.append(SimpleNamespace(control=control, landmarks=seen, z=z, cov_z=cov_z))
        poses.append(pose)
    return frames, np.array(poses), lamps


def main() -> dict[str, float]:
    """Checks the model, runs the filter and prints its errors and those of odometry alone."""
    findings = check_model(LampSensor(), SE2)
    print("check_model:", "; ".join(findings) or "LampSensor is sound")

    frames, truth, lamps = simulate(np.random.default_rng(3))
    lamp_map = LandmarkMap(SE2)
    sensor = NamedLandmarkSensor(LampSensor(), Point(2))
    filter_ = Filter(OdometryMotion(SE2), sensor, lamp_map, n=100, rng=np.random.default_rng(0))
    reports = [filter_.step(frame, frame.control) for frame in frames]

    by_odometry = [SE2.identity()]
    for frame in frames[1:]:
        by_odometry.append(SE2.compose(by_odometry[-1], frame.control.delta))
    estimates = np.array([report.estimate.mean for report in reports])
    points, _ = filter_.belief().moments(lamp_map.ids)
    used = [report for report in reports if report.rows]
    figures = {
        "findings": len(findings),
        "odometry": float(np.linalg.norm((np.array(by_odometry) - truth)[:, 1:], axis=1).mean()),
        "filter": float(np.linalg.norm((estimates - truth)[:, 1:], axis=1).mean()),
        "map": float(np.linalg.norm(points - lamps[lamp_map.ids], axis=1).mean()),
        "nis_per_dof": sum(report.nis for report in used) / sum(report.rows for report in used),
    }
    print(f"mean position error: odometry {figures['odometry']:.3f} m, filter {figures['filter']:.3f} m")
    print(f"{lamp_map.ids.size} lamps mapped, mean error {figures['map']:.3f} m")
    print(f"squared innovations are {figures['nis_per_dof']:.2f} times what the model expects (1 is honest)")
    return figures


if __name__ == "__main__":
    main()
