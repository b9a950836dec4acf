"""GPS, wheels and a biased gyroscope: preintegration of 50 Hz odometry between position fixes at 1 Hz.

Particles that sample noise fifty times between two measurements disperse, and a sampled bias degenerates to copies of one
value. So the increments of a second are composed into one, with its covariance, and the bias, which rotates it, is part of
one Gaussian with the frame of the last few steps. For 25 s there is no fix.
"""

import numpy as np

from rbpf import (
    SE2,
    Consolidation,
    Filter,
    JointMap,
    MotionModel,
    ObservationModel,
    Observations,
    Part,
    Sensor,
    Transition,
)
from rbpf.gaussian import psd_factor
from rbpf.motion.odometry import Odometry, preintegrate

RATE, SECONDS, OUTAGE = 50, 120, range(60, 85)
STD_TICK = np.array([0.002, 0.01, 0.002])  # increment: turn [rad], forward [m], to the left [m]
STD_BIAS, WALK_BIAS, STD_FIX = 0.05, 0.0002, 0.5  # rad/s, rad/s per √s, m
BY_BIAS = np.array([[-1.0 / RATE], [0.0], [0.0]])  # ∂increment/∂bias


class Driven(MotionModel):
    """x' = x · delta · Exp(B bias + w); the control is the result of `preintegrate`."""

    space = SE2

    def transition(self, state, control, dt):
        moved, by_bias = control or (Odometry.at_rest(SE2), np.zeros((3, 1)))
        noise = np.zeros((4, 4))
        noise[:3, :3], noise[3, 3] = psd_factor(moved.cov), WALK_BIAS * np.sqrt(dt)
        ahead = SE2.compose(state, moved.delta)
        return Transition(ahead, noise[None], by_bias[None], np.eye(1)[None], np.zeros((1, 1)))


class Position(ObservationModel):
    """z = (x, y) of the robot [m]; observes only the sampled state."""

    dim = 2
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return SE2.translation(state)


class Receiver(Sensor):
    """A frame is a fix (2,), or None without one."""

    def observe(self, frame, belief):
        if frame is None:
            return []
        return [Observations(frame[None], STD_FIX**2 * np.eye(2)[None], Position())]


def simulate(rng: np.random.Generator) -> list[tuple[np.ndarray, float, np.ndarray | None, np.ndarray | None]]:
    """True pose and bias, the ticks (RATE, 3) of the last second and the fix, at each second."""
    pose, bias, out = SE2.identity(), STD_BIAS * rng.standard_normal(), []
    for second in range(SECONDS):
        ticks = None
        if second:
            ticks = np.tile([0.3 * np.sin(0.1 * second) / RATE, 5.0 / RATE, 0.0], (RATE, 1))
            for tick in ticks:
                pose = SE2.retract(pose, tick + STD_TICK * rng.standard_normal(3))
            ticks[:, 0] += bias / RATE
            bias += WALK_BIAS * rng.standard_normal()
        fix = pose[1:] + STD_FIX * rng.standard_normal(2) if second not in OUTAGE else None
        out.append((pose, bias, ticks, fix))
    return out


def track(world: list, seed: int) -> tuple[np.ndarray, np.ndarray, Filter]:
    """Errors (T, 3) in the chart of the estimate, and NEES (T,)."""
    held, window = JointMap(SE2, (np.zeros(1), STD_BIAS**2 * np.eye(1))), Consolidation(window=5)
    rng, errors, nees = np.random.default_rng(seed), [], []
    filter_ = Filter(Driven(), Receiver(), held, rng=rng, lag=1, consolidation=window)
    for pose, _, ticks, fix in world:
        filter_.step(fix, None if ticks is None else preintegrate(ticks, np.diag(STD_TICK**2), BY_BIAS, SE2))
        mean, cov = filter_.belief().moments(Part.STATE)
        errors.append(SE2.local(mean, pose))
        nees.append(errors[-1] @ np.linalg.pinv(cov, hermitian=True) @ errors[-1])
    return np.array(errors), np.array(nees), filter_


def main() -> dict[str, float]:
    """Tracks in four worlds, with the default number of particles."""
    figures = []
    for seed in range(4):
        world = simulate(np.random.default_rng(seed))
        errors, nees, filter_ = track(world, seed)
        away = np.linalg.norm(errors[:, 1:], axis=1)
        before, gone = np.sqrt(np.square(away[20:60]).mean()), away[max(OUTAGE)]
        figures.append([before, gone, nees[1:].mean() / 3, len(filter_.health.findings)])
        print(
            f"world {seed}: {before:.2f} m RMS, {gone:.2f} m after 25 s without a fix, NEES per number {figures[-1][2]:.2f}"
        )
    rmse, gone, nees, findings = np.transpose(figures)
    return {"rmse": rmse.max(), "gone": gone.max(), "nees": nees.max(), "least": nees.min(), "findings": findings.sum()}


if __name__ == "__main__":
    main()
