"""Compares a run with the batch optimum of its measurements: differences, in metres and sigma, and overconfidence.

For a run in memory (`compare_run`) or a folder written by `rbpf run` (`compare_folder`), of any system.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from rbpf.runs.files import write_table
from rbpf.runs.recordings import RobotRecording, filter_recording
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.against_batch import compare_run
from rbpf.validation.report.comparison_pictures import plot_against_batch
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


def main(quick: bool = False, out: Path = Path("out")) -> dict[str, float]:
    """Prints the filter's distance from the optimum for few and many particles; `quick` uses a short log."""
    out.mkdir(parents=True, exist_ok=True)
    rows, figures = [], {}
    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(steps=60 if quick else 200, landmarks=30), Path(folder), seed=0)
        for particles in (10, 300):
            run = filter_recording(RobotRecording(Path(folder)), RangeBearingConfig(particles=particles))
            found = compare_run(run)
            told = found.landmarks.as_dict()
            names = "distances_m", "sigmas", "kullback_leibler", "sigma_ratio"
            rows.append((particles, found.path.rmse, *(told[f"{name}_median"] for name in names)))
            figures[f"{particles} particles"] = told["kullback_leibler_median"]
    header = ("particles", "path_rmse_m", "landmark_m", "landmark_sigmas", "kl_nats", "sigma_ratio")
    write_table(out / "against_batch.csv", header, rows)
    plot_against_batch(found, out)
    return figures


if __name__ == "__main__":
    main()
