"""Range-bearing SLAM from a log to a path, a map and a verdict, in a few lines.

The robot drives two laps of a circle and measures range and bearing of nearby landmarks. FastSLAM 2.0 filters its log;
GTSAM computes the batch optimum of the same measurements. The plot shows both paths, odometry alone, the ground truth,
and the landmarks with 3σ ellipses.
"""

import shutil
from pathlib import Path

import tyro

from rbpf.runs.files import write_table
from rbpf.runs.recordings import RobotRecording, filter_recording
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.finish import finish_run
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

FIGURES = ("odometry_path_rmse_m", "path_rmse_m", "batch_path_rmse_m", "nis_per_dof", "ess_mean")


def main(
    steps: int = 200,
    particles: int = 100,
    seed: int = 1,
    out: Path = Path("demo/range_bearing_robot"),
    quick: bool = False,
) -> dict[str, float]:
    """Simulates, filters, and prints the main figures.

    Args:
        steps: number of steps of the log.
        particles: number of particles.
        seed: seed of world and filter.
        out: folder for log, run, table and plot.
        quick: uses a short log.
    """
    steps = 40 if quick else steps
    simulate_robot(RobotWorld(steps=steps, landmarks=60), out / "log", seed)
    recording = RobotRecording(out / "log")
    run = filter_recording(recording, RangeBearingConfig(particles=particles, seed=seed))
    entries = finish_run(run, out / "run", recording.sources())
    figures = {name: float(entries[name]) for name in FIGURES}
    write_table(out / "figures.csv", ["figure", "value"], [[name, value] for name, value in figures.items()])
    shutil.copy(out / "run" / "map.png", out / "map.png")
    print(f"pictures and the report with its verdict are in {out / 'run'}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
