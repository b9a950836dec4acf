"""Tracking without a map: the nonlinear state is sampled, the linear one marginalised.

A radar measures range and bearing of a vessel. Its pose is sampled. Its turn rate and speed drive the pose
linearly, in the chart of the pose, and are a Gaussian in every particle. The same number of particles is then
more accurate than in a bootstrap filter that samples all five numbers.
"""

import numpy as np

from rbpf import (
    SE2,
    EkfProposal,
    Euclidean,
    Filter,
    KalmanSubstate,
    MotionModel,
    ObservationModel,
    Observations,
    Part,
    PriorProposal,
    Product,
    Sensor,
    Transition,
)

PARTICLES, STEPS, VESSELS, REPEATS = 100, 40, 3, 4
STD_POSE = np.array([0.02, 0.2, 0.2])  # disturbance per step: turn [rad], forward [m], to the left [m]
STD_RATES = np.array([0.01, 0.15])  # change per step of turn rate [rad/s] and speed [m/s]
STD_RADAR = np.array([5.0, 0.03])  # range [m], bearing [rad]
MEAN_RATES, COV_RATES = np.array([0.0, 4.0]), np.diag([0.05, 1.0]) ** 2
START = np.array([0.5, 60.0, 20.0])
DRIVES = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])  # (turn rate, speed) -> tangent [turn, forward, left]


class Vessel(MotionModel):
    """Pose in SE(2), x' = x Exp(dt B s + w1); s = (turn rate, speed) is a random walk and is marginalised."""

    space = SE2

    def transition(self, state, control, dt):
        noise = np.diag(np.concatenate([STD_POSE, STD_RATES]))
        return Transition(
            mean=state,
            noise_factor=noise[None],
            coupling=dt * DRIVES[None],
            dynamics=np.eye(2)[None],
            drift=np.zeros((1, 2)),
        )


class SampledVessel(MotionModel):
    """The same vessel with all five numbers sampled."""

    space = Product(SE2, Euclidean(2))

    def transition(self, state, control, dt):
        pose, rates = self.space.split(state)
        moved = SE2.retract(pose, dt * rates @ DRIVES.T)
        noise = np.diag(np.concatenate([STD_POSE, STD_RATES]))
        return Transition(self.space.join([moved, rates]), noise[None])


class Radar(ObservationModel):
    """z = (range [m], bearing [rad]) from the origin; a pose in SE(2) is the first part of the state."""

    dim = 2
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        x, y = state[..., 1], state[..., 2]
        return np.stack([np.hypot(x, y), np.arctan2(y, x)], axis=-1)

    def residual(self, z, predicted):
        difference = z - predicted
        difference[..., 1] = (difference[..., 1] + np.pi) % (2 * np.pi) - np.pi
        return difference


class RadarSensor(Sensor):
    """A frame is one measurement (2,)."""

    def __init__(self):
        self.model = Radar()

    def observe(self, frame, belief):
        return [Observations(frame[None], np.diag(STD_RADAR**2)[None], self.model)]


def simulate(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """True poses (T, 3) and measurements (T, 2), drawn from the model."""
    pose, rates, poses = START, rng.multivariate_normal(MEAN_RATES, COV_RATES), []
    for t in range(STEPS):
        dt = 1.0 if t else 0.0  # no time passes before the first step
        pose = SE2.retract(pose, dt * DRIVES @ rates + STD_POSE * rng.normal(size=3))
        rates = rates + STD_RATES * rng.normal(size=2)
        poses.append(pose)
    return np.array(poses), Radar().predict(np.array(poses)) + STD_RADAR * rng.normal(size=(STEPS, 2))


def marginalised(rng: np.random.Generator, proposal: EkfProposal | PriorProposal) -> Filter:
    """A filter that samples only the pose."""
    rates = KalmanSubstate(SE2, MEAN_RATES, COV_RATES)
    return Filter(Vessel(), RadarSensor(), rates, proposal, n=PARTICLES, rng=rng, start=START)


def bootstrap(rng: np.random.Generator) -> Filter:
    """A filter that samples everything, from the motion model."""
    rates = rng.multivariate_normal(MEAN_RATES, COV_RATES, PARTICLES)
    start = np.concatenate([np.tile(START, (PARTICLES, 1)), rates], axis=1)
    return Filter(SampledVessel(), RadarSensor(), (), PriorProposal(), n=PARTICLES, rng=rng, start=start)


def main() -> dict[str, dict[str, float]]:
    """Tracks the same vessels with three filters of one size; prints their errors and the spread of their evidence."""
    filters = {
        "bootstrap, all five numbers sampled": bootstrap,
        "rates marginalised, prior proposal": lambda rng: marginalised(rng, PriorProposal()),
        "rates marginalised, EKF proposal": lambda rng: marginalised(rng, EkfProposal()),
    }
    vessels = [simulate(np.random.default_rng(seed)) for seed in range(VESSELS)]
    figures = {}
    for name, build in filters.items():
        square, spread = [], []
        for truth, measurements in vessels:
            evidence = []
            for seed in range(REPEATS):
                filter_ = build(np.random.default_rng(100 + seed))
                poses = np.array([filter_.step(z).estimate.mean[:3] for z in measurements])
                square.append(np.square(SE2.local(poses, truth)))
                evidence.append(filter_.log_evidence)
            spread.append(np.std(evidence))
        turn, forward, left = np.mean(square, axis=(0, 1))
        figures[name] = {
            "position_rmse": float(np.sqrt(forward + left)),
            "heading_rmse": float(np.sqrt(turn)),
            "spread": float(np.mean(spread)),
        }
        position, heading, sd = figures[name].values()
        print(
            f"{name:>36}: position {position:.2f} m RMS, heading {np.degrees(heading):4.1f}°, "
            f"log-evidence ± {sd:.1f} from seed to seed"
        )
    return figures


if __name__ == "__main__":
    main()
