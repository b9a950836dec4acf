"""Range-only SLAM: a landmark starts as a ring of Gaussians and becomes a point.

One range constrains a beacon to a circle, which every particle represents by a mixture; later ranges raise
the weights of the components near the beacon, until one of them dominates and becomes a point.
"""

from types import SimpleNamespace

import numpy as np
from scipy.optimize import least_squares

from rbpf import SE2, Filter, LandmarkMap, MixturePoint, ObservationModel
from rbpf.maps.point import ring, ring_components
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor

STD_RANGE = 0.1  # [m]
STD_ODOMETRY = np.array([0.005, 0.01, 0.005])  # turn [rad], forward [m], to the left [m]
COMPONENTS = ring_components(20.0, STD_RANGE)  # for beacons up to 20 m away
BEACONS = np.array([[6.0, 5.0], [-4.0, 6.0], [3.0, -5.0], [10.0, -1.0], [-5.0, -3.0]])


class Range(ObservationModel):
    """z = (distance,) to a beacon [m]; a first observation initialises a ring around the robot."""

    dim = 1

    def predict(self, state, landmark=None, const=None, substate=None):
        return np.linalg.norm(landmark - SE2.translation(state), axis=-1, keepdims=True)

    def initialise(self, state, z, cov):
        return ring(SE2.translation(state), z[:, 0], STD_RANGE, COMPONENTS)


def simulate(rng: np.random.Generator, steps: int = 200) -> list[tuple[np.ndarray, SimpleNamespace]]:
    """True pose and frame of every step; the robot drives a winding path among the beacons."""
    pose, out = SE2.identity(), []
    for t in range(steps):
        control = None
        if t:
            increment = SE2.exp(np.array([0.15 * np.cos(0.1 * t), 0.15, 0.0]))
            pose = SE2.compose(pose, increment)
            measured = SE2.retract(increment, STD_ODOMETRY * rng.normal(size=3))
            control = Odometry(measured, np.diag(STD_ODOMETRY**2))
        z = Range().predict(pose, BEACONS) + STD_RANGE * rng.normal(size=(len(BEACONS), 1))
        cov_z = np.full((len(BEACONS), 1, 1), STD_RANGE**2)
        frame = SimpleNamespace(control=control, landmarks=np.arange(len(BEACONS)), z=z, cov_z=cov_z)
        out.append((pose, frame))
    return out


def optimum(frames: list[SimpleNamespace], poses: np.ndarray, beacons: np.ndarray) -> np.ndarray:
    """Beacons (M, 2) by batch least squares over the whole path, initialised at poses (T, 3) and beacons (M, 2)."""

    def residuals(unknown):
        path = np.concatenate([poses[:1], unknown[: 3 * len(frames) - 3].reshape(-1, 3)])
        ranges = Range().predict(path[:, None], unknown[3 * len(frames) - 3 :].reshape(-1, 2))
        moved = SE2.local(np.array([frame.control.delta for frame in frames[1:]]), SE2.between(path[:-1], path[1:]))
        off = ranges - np.array([frame.z for frame in frames])
        return np.concatenate([off.ravel() / STD_RANGE, (moved / STD_ODOMETRY).ravel()])

    found = least_squares(residuals, np.concatenate([poses[1:].ravel(), beacons.ravel()]), max_nfev=4, tr_solver="lsmr")
    return found.x[-beacons.size :].reshape(-1, 2)


def main() -> dict[str, float]:
    """Prints when each beacon becomes a point, and its final error."""
    beacon_map = LandmarkMap(SE2)
    sensor = NamedLandmarkSensor(Range(), MixturePoint(COMPONENTS))
    filter_ = Filter(OdometryMotion(SE2), sensor, beacon_map, n=50, rng=np.random.default_rng(0))
    truth, frames = zip(*simulate(np.random.default_rng(2)), strict=True)
    poses, promoted = [], {}
    for t, frame in enumerate(frames):
        poses.append(filter_.step(frame, frame.control).estimate.mean)
        ready = beacon_map.ready(filter_.particles.weights)
        beacon_map.promote(ready)
        promoted |= dict.fromkeys(ready.tolist(), t)
    points, cov = filter_.belief().moments(np.arange(len(BEACONS)))
    batch = optimum(list(frames), np.array(poses), points)
    off, sigma = np.linalg.norm(points - BEACONS, axis=1), np.sqrt(np.trace(cov, axis1=1, axis2=2))
    apart, path = (
        np.linalg.norm(points - batch, axis=1),
        float(np.linalg.norm((np.array(poses) - truth)[:, 1:], axis=1).mean()),
    )
    for beacon, step in promoted.items():
        print(
            f"beacon {beacon}: a point since step {step}, {off[beacon]:.3f} ± {sigma[beacon]:.3f} m off, "
            f"{apart[beacon]:.3f} m from the least-squares solution"
        )
    print(f"mean position error of the robot: {path:.2f} m")
    return {"promoted": len(promoted), "map": float(off.max()), "path": path, "from_batch": float(apart.max())}


if __name__ == "__main__":
    main()
