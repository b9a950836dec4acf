"""A whole update of 50 particles that observe 30 of 300 landmarks, against a plain loop and the NumPy twin."""

from itertools import islice

import numpy as np

from benchmarks.plain_fastslam import PlainFastSlam
from benchmarks.rows import Row, Settings, interleaved
from benchmarks.worlds import STD_LANDMARK, Run, planar

N, K, M = 50, 30, 300
CALLS = {"rbpf": 20, "twin": 3}


class LoopRun:
    """The textbook loop on the same world, with the same random numbers."""

    def __init__(self, steps: int) -> None:
        world = planar(K, M)
        self.slam = PlainFastSlam(world.start(), world.guesses, STD_LANDMARK, N, np.random.default_rng(0))
        self.frames = list(islice(world.frames(), steps))[::-1]

    def step(self) -> None:
        self.slam.step(self.frames.pop())


def largest_difference(steps: int = 5) -> float:
    """Largest difference of loop and filter in states and log-weights, over a few steps."""
    ours, loop = Run(planar(K, M), N, steps), LoopRun(steps)
    worst = 0.0
    for _ in range(steps):
        ours.step()
        loop.step()
        gap = ours.filter.particles.state - np.array([particle.pose for particle in loop.slam.particles])
        gap[:, 0] = (gap[:, 0] + np.pi) % (2 * np.pi) - np.pi
        gap_weights = ours.filter.particles.log_weights - loop.slam.log_weights
        worst = max(worst, np.abs(gap).max(), np.abs(gap_weights).max())
    return float(worst)


def run(settings: Settings) -> list[Row]:
    """Rows against the loop and against the twin."""
    difference = largest_difference()
    if difference > 1e-6:
        raise RuntimeError(f"the plain loop is not the same filter: it differs by {difference:.1e}")
    turns = settings.repetitions(30)
    ours = Run(planar(K, M), N, CALLS["rbpf"] * (turns + 2))
    twin = Run(planar(K, M), N, CALLS["twin"] * (turns + 2), compiled=False)
    times = interleaved({"rbpf": ours.step, "twin": twin.step, "loop": LoopRun(turns + 2).step}, turns, CALLS)
    spent = times["rbpf"].median * 1e3
    same = f"same result within {difference:.0e}; "
    notes = f"{times['rbpf'].spread}; {ours.diversity.text()}"
    return [
        row("loop", "plain per-particle loop", spent, times["loop"].median * 1e3, same + notes),
        row("twin", "its NumPy twin", spent, times["twin"].median * 1e3, notes),
    ]


def row(label: str, text: str, ours: float, theirs: float, notes: str) -> Row:
    return Row(f"update 50x30x300 vs {label}", ours, "ms", text, theirs, theirs / ours, notes=notes)
