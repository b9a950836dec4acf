"""Model comparison by evidence: does a vessel turn or go straight?

Radar tracks the vessels of `target_tracking`; some keep turning, some go straight except for disturbances. One model
has a turn rate, the other one does not. The evidence p(z_1:T) of a model needs no ground truth and no penalty for the
number of parameters: an unnecessary turn rate spreads the predictions, which lowers the evidence. The plot shows the
difference of the log-evidences over time, one line per seed of the filters.
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from target_tracking import (
    COV_RATES,
    DRIVES,
    MEAN_RATES,
    START,
    STD_POSE,
    STD_RADAR,
    STD_RATES,
    Radar,
    RadarSensor,
    Vessel,
)

from rbpf import SE2, Filter, KalmanSubstate, MotionModel, Transition
from rbpf.runs.files import write_table
from rbpf.validation.consistency.model_comparison import EvidenceDifference, evidence_difference

TURN_RATES = {"turns": 0.02, "goes straight on": 0.0}  # true mean turn rate [rad/s]
SPEED = 4.0  # [m/s]


class Straight(MotionModel):
    """The vessel without a turn rate: only the speed drives it, and is marginalised."""

    space = SE2

    def transition(self, state, control, dt):
        return Transition(
            mean=state,
            noise_factor=np.diag([*STD_POSE, STD_RATES[1]])[None],
            coupling=dt * DRIVES[None, :, 1:],
            dynamics=np.eye(1)[None],
            drift=np.zeros((1, 1)),
        )


MODELS = {
    "with turn rate": (Vessel(), MEAN_RATES, COV_RATES),
    "without": (Straight(), MEAN_RATES[1:], COV_RATES[1:, 1:]),
}


def simulate(rng: np.random.Generator, turn_rate: float, steps: int) -> np.ndarray:
    """Radar measurements (T, 2) of a vessel with a given turn rate [rad/s]."""
    pose, poses = START, []
    for t in range(steps):
        dt = 1.0 if t else 0.0
        pose = SE2.retract(pose, dt * DRIVES @ [turn_rate, SPEED] + STD_POSE * rng.normal(size=3))
        poses.append(pose)
    return Radar().predict(np.array(poses)) + STD_RADAR * rng.normal(size=(steps, 2))


def log_evidence(measurements: np.ndarray, model: str, particles: int, seed: int) -> np.ndarray:
    """Log-evidence of the measurements so far, after each step (T,)."""
    motion, mean, cov = MODELS[model]
    substate, rng = KalmanSubstate(SE2, mean, cov), np.random.default_rng(seed)
    filter_ = Filter(motion, RadarSensor(), substate, n=particles, rng=rng, start=START)
    return np.cumsum([filter_.step(z).log_evidence for z in measurements])


def draw(curves: dict[str, np.ndarray], path: Path) -> None:
    """Plots differences (S, T) of the log-evidences over time."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for number, (name, lines) in enumerate(curves.items()):
        axes.plot(lines.T, color=f"C{number}", alpha=0.5, label=[f"vessel {name}", *[""] * (len(lines) - 1)])
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.set(xlabel="step", ylabel="log-evidence: with turn rate − without")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


def main(
    steps: int = 40, particles: int = 500, seeds: int = 8, out: Path = Path("demo/motion_evidence"), quick: bool = False
) -> dict[str, EvidenceDifference]:
    """Compares both models on both recordings.

    Args:
        steps: number of steps of each recording, of one second.
        particles: number of particles of each filter.
        seeds: number of filters per model and recording.
        out: folder for table and plot.
        quick: few seeds.
    """
    seeds = 4 if quick else seeds
    out.mkdir(parents=True, exist_ok=True)
    curves, found = {}, {}
    for name, turn_rate in TURN_RATES.items():
        measurements = simulate(np.random.default_rng(7), turn_rate, steps)
        with_rate, without = (
            np.array([log_evidence(measurements, model, particles, seed) for seed in range(seeds)]) for model in MODELS
        )
        curves[name] = with_rate - without
        found[name] = evidence_difference(with_rate[:, -1], without[:, -1])
        print(f"the vessel {name}: {found[name].sentence('the model with a turn rate', 'the one without')}")
    rows = [[name, item.difference, item.error] for name, item in found.items()]
    write_table(out / "evidence.csv", ["vessel", "difference", "error"], rows)
    draw(curves, out / "evidence.png")
    return found


if __name__ == "__main__":
    tyro.cli(main)
