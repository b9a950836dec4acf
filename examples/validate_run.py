"""Accuracy and consistency of a run: its folder compared with ground truth and with its batch optimum.

The same as `rbpf validate RUN --against groundtruth` and `--against gtsam`: each comparison writes a JSON file, plots,
and the two lights on top of RUN/report.html.
"""

from pathlib import Path

import tyro

from rbpf.runs.files import write_table
from rbpf.runs.recordings import RobotRecording, filter_recording
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.comparison import read_comparisons
from rbpf.validation.finish import finish_run, validate
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


def main(
    steps: int = 200, particles: int = 500, seed: int = 1, out: Path = Path("demo/validate_run"), quick: bool = False
) -> dict[str, str]:
    """Simulates, filters, compares and prints the results.

    Args:
        steps: number of steps of the recording.
        particles: number of particles.
        seed: seed of the world and of the filter.
        out: folder for recording and run.
        quick: uses a short run.
    """
    steps, particles = (40, 50) if quick else (steps, particles)
    log, run = out / "log", out
    simulate_robot(RobotWorld(steps=steps, landmarks=80), log, seed)
    recording, config = RobotRecording(log), RangeBearingConfig(particles=particles, seed=seed)
    finish_run(filter_recording(recording, config), run, recording.sources())
    verdicts = {against: validate(run, against) for against in ("groundtruth", "gtsam")}
    rows = [
        [comparison.against, s.name, s.value, s.low, s.high, s.outcome]
        for comparison in read_comparisons(run)[0]
        for s in comparison.statistics
    ]
    write_table(out / "statistics.csv", ["against", "statistic", "value", "from", "to", "says"], rows)
    for sentence in verdicts["gtsam"].sentences:
        print(sentence)
    return {against: verdict.trust for against, verdict in verdicts.items()}


if __name__ == "__main__":
    tyro.cli(main)
