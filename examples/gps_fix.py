"""A sensor that sees no landmark: position fixes, now and then, correct dead reckoning in the plane.

The robot does not know which way it faces when it starts. Every particle has its own guess, and the fixes
tell which guesses lead along the path that was driven. Nothing is marginalised here, so the filter needs no
map.
"""

import numpy as np

from rbpf import SE2, Filter, ObservationModel, Observations, Part, Sensor
from rbpf.motion.odometry import Odometry, OdometryMotion

STD_FIX = 0.5  # of each coordinate [m]
STD_ODOMETRY = np.array([0.01, 0.05, 0.02])  # turn [rad], forward [m], to the left [m]
FIX_EVERY = 10  # steps
PARTICLES = 300


class Position(ObservationModel):
    """z = (x, y) of the robot [m]; reads the sampled state and nothing else."""

    dim = 2
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return SE2.translation(state)


class PositionReceiver(Sensor):
    """A frame is one fix (2,), or None where there is none; `std` is that of each coordinate [m]."""

    def __init__(self, std):
        self.model = Position()
        self.cov = std**2 * np.eye(2)[None]

    def observe(self, frame, belief):
        if frame is None:
            return []
        return [Observations(z=frame[None], cov=self.cov, model=self.model)]


def simulate(rng: np.random.Generator, steps: int = 200) -> list[tuple[np.ndarray, Odometry | None, np.ndarray | None]]:
    """True pose, odometry and fix of every step; the robot starts at the origin, facing 2 rad to the left."""
    pose, out = np.array([2.0, 0.0, 0.0]), []
    for t in range(steps):
        control = None
        if t:
            increment = SE2.exp(np.array([0.05 * np.sin(0.03 * t), 0.5, 0.0]))
            pose = SE2.compose(pose, increment)
            measured = SE2.retract(increment, STD_ODOMETRY * rng.normal(size=3))
            control = Odometry(measured, np.diag(STD_ODOMETRY**2))
        fix = pose[1:] + STD_FIX * rng.normal(size=2) if t % FIX_EVERY == 0 else None
        out.append((pose, control, fix))
    return out


def main() -> dict[str, float]:
    """Runs the filter; prints how well heading and position are known as fixes come in."""
    guesses = np.zeros((PARTICLES, 3))
    guesses[:, 0] = np.linspace(-np.pi, np.pi, PARTICLES, endpoint=False)
    filter_ = Filter(
        OdometryMotion(SE2), PositionReceiver(STD_FIX), n=PARTICLES, rng=np.random.default_rng(0), start=guesses
    )
    errors, sigmas = [], []
    for t, (true_pose, control, fix) in enumerate(simulate(np.random.default_rng(1))):
        estimate = filter_.step(fix, control).estimate
        error = SE2.local(estimate.mean, true_pose)
        errors.append(error)
        sigmas.append(np.sqrt(np.diag(estimate.cov)))
        if t in (9, 10, 30, 100, 199):
            heading, sigma = np.degrees([error[0], sigmas[-1][0]])
            away = np.hypot(*error[1:])
            print(f"step {t:3d}: heading {heading:6.1f}° off (σ {sigma:5.1f}°), position {away:.2f} m off")
    late = np.array(errors)[100:]
    figures = {
        "sigma_heading_start": float(sigmas[0][0]),
        "sigma_heading_end": float(sigmas[-1][0]),
        "heading_rmse": float(np.sqrt(np.square(late[:, 0]).mean())),
        "position_rmse": float(np.sqrt(np.square(late[:, 1:]).sum(axis=1).mean())),
        "share_within_3_sigma": float((np.abs(late) < 3 * np.array(sigmas)[100:]).mean()),
    }
    print(f"second half: {figures['position_rmse']:.2f} m RMS, from fixes of {STD_FIX * 2**0.5:.2f} m RMS")
    return figures


if __name__ == "__main__":
    main()
