"""Smoothing: the posterior of early states given the whole recording.

A point on a line moves at random, and only its distance from a post beside the line is measured, so that the side
of the post is ambiguous until a late measurement of the position. The filter cannot resolve early ambiguity;
smoothing does.
"""

import numpy as np

from rbpf import Euclidean, Filter, MotionModel, ObservationModel, Observations, Part, Sensor, Transition
from rbpf.core.smoothing import ancestral_smoothing, backward_simulation

STEPS, STD_STEP, STD_RANGE, STD_FIX = 60, 0.2, 0.1, 0.3  # metres


class Walk(MotionModel):
    """x' = x + w."""

    space = Euclidean(1)

    def transition(self, state, control, dt):
        return Transition(state, np.array([[[STD_STEP]]]))


class PostRange(ObservationModel):
    """z = (distance,) from a post at one metre from the line."""

    dim = 1
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return np.sqrt(1.0 + state**2)


class Fix(ObservationModel):
    """z = (position,) on the line."""

    dim = 1
    reads = frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state


class Surveyor(Sensor):
    """A frame is a range, and a fix or None: two groups of observations, each with its own model."""

    def __init__(self):
        self.range, self.fix = PostRange(), Fix()

    def observe(self, frame, belief):
        distance, fix = frame
        groups = [Observations(np.array([[distance]]), np.array([[[STD_RANGE**2]]]), self.range)]
        if fix is not None:
            groups.append(Observations(np.array([[fix]]), np.array([[[STD_FIX**2]]]), self.fix))
        return groups


def simulate(rng: np.random.Generator) -> tuple[np.ndarray, list[tuple[float, float | None]]]:
    """True positions (T,), and frames: a range in each, and a fix in the last one."""
    truth = 2.0 + np.cumsum(STD_STEP * rng.normal(size=STEPS))
    ranges = np.sqrt(1.0 + truth**2) + STD_RANGE * rng.normal(size=STEPS)
    fixes = [None] * (STEPS - 1) + [truth[-1] + STD_FIX * rng.normal()]
    return truth, list(zip(ranges, fixes, strict=True))


def main() -> dict[str, float]:
    """Prints the errors of the filter and of both smoothers over the whole recording."""
    truth, frames = simulate(np.random.default_rng(4))
    rng = np.random.default_rng(0)
    start = rng.normal(0.0, 3.0, (500, 1))
    filter_ = Filter(Walk(), Surveyor(), n=500, rng=rng, start=start, clouds=True)
    filtered = np.array([filter_.step(frame).estimate.mean[0] for frame in frames])
    ancestral = ancestral_smoothing(filter_.space, filter_.history, filter_.particles.weights)
    backward = backward_simulation(filter_.motion, filter_.history, 200, rng)

    estimates = {"filter": filtered, "ancestral paths": ancestral.mean[:, 0], "backward": backward.mean[:, 0]}
    figures = {name: float(np.sqrt(np.square(path - truth).mean())) for name, path in estimates.items()}
    for name, error in figures.items():
        print(f"{name:>16}: {error:.2f} m RMS")
    figures["ancestors"] = filter_.history.distinct_first()
    print(f"of the first step's {filter_.n} particles, {figures['ancestors']} still have descendants")
    return figures


if __name__ == "__main__":
    main()
