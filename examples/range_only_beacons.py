"""Range-only beacons: a landmark that starts as a ring of Gaussians and ends as one.

One range says that a beacon lies on a circle. Every particle keeps that circle as a mixture; later ranges
raise the weights of the components near the beacon, until one of them dominates and takes over as a point.
"""

from types import SimpleNamespace

import numpy as np

from rbpf import SE2, Filter, LandmarkMap, MixturePoint, ObservationModel
from rbpf.maps.point import ring, ring_components
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor

STD_RANGE = 0.1  # [m]
STD_ODOMETRY = np.array([0.005, 0.01, 0.005])  # turn [rad], forward [m], to the left [m]
COMPONENTS = ring_components(20.0, STD_RANGE)  # enough for beacons up to 20 m away
BEACONS = np.array([[6.0, 5.0], [-4.0, 6.0], [3.0, -5.0], [10.0, -1.0], [-5.0, -3.0]])


class Range(ObservationModel):
    """z = (distance,) to a beacon [m]; a first observation starts a ring around the robot."""

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


def main() -> dict[str, float]:
    """Prints when each beacon becomes a point, and how far off it is in the end."""
    beacon_map = LandmarkMap(SE2)
    sensor = NamedLandmarkSensor(Range(), MixturePoint(COMPONENTS))
    filter_ = Filter(OdometryMotion(SE2), sensor, beacon_map, n=50, rng=np.random.default_rng(0))
    errors, promoted = [], {}
    for t, (true_pose, frame) in enumerate(simulate(np.random.default_rng(2))):
        estimate = filter_.step(frame, frame.control).estimate
        errors.append(np.linalg.norm((estimate.mean - true_pose)[1:]))
        ready = beacon_map.ready(filter_.particles.weights)
        beacon_map.promote(ready)
        promoted |= dict.fromkeys(ready.tolist(), t)
    belief = filter_.belief()
    distances = {}
    for beacon, step in promoted.items():
        mean = np.einsum("n,nd->d", belief.weights, belief.read([beacon]).mean[:, 0])
        distances[beacon] = float(np.linalg.norm(mean - BEACONS[beacon]))
        print(f"beacon {beacon}: a point since step {step}, {distances[beacon]:.2f} m off")
    print(f"still a ring: {len(BEACONS) - len(promoted)} of {len(BEACONS)} beacons")
    print(f"mean position error of the robot: {np.mean(errors):.2f} m")
    return {"promoted": len(promoted), "map": max(distances.values()), "path": float(np.mean(errors))}


if __name__ == "__main__":
    main()
