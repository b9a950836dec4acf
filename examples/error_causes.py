"""Why is a filter further from the truth than the batch optimum of its measurements? One thing changed at a time.

`--recording` is a robot's log; `--run` the folder of a finished monocular run with ground truth. Without either a log
is simulated. The table has one row for each change: the error with it, and its ratio to the batch's; the picture
shows the errors.
"""

from pathlib import Path

import tyro
from matplotlib.figure import Figure

from rbpf.runs.plots import COLOURS, new_axes, save_figures
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.error_causes import HEADER, Cause, camera_causes, robot_causes
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot
from rbpf.validation.tables import write_table


def main(
    recording: Path | None = None,
    run: Path | None = None,
    seeds: int = 3,
    out: Path = Path("out/error_causes"),
    quick: bool = False,
) -> dict[str, float]:
    """Prints the table, and writes it.

    Args:
        recording: a robot's log with ground truth.
        run: folder of a monocular run.
        seeds: of the filter, for each change.
        out: folder for the table.
        quick: a few steps and particles.
    """
    out.mkdir(parents=True, exist_ok=True)
    particles = 20 if quick else 100
    causes: list[Cause]
    if run is not None:
        causes = camera_causes(run, range(seeds), told=print)
    else:
        if recording is None:
            recording = out / "log"
            if not recording.exists():
                simulate_robot(RobotWorld(steps=30 if quick else 200, landmarks=25), recording, seed=0)
        causes = robot_causes(recording, RangeBearingConfig(particles=particles), range(seeds), told=print)
    write_table(out / "causes.csv", list(HEADER), [cause.row() for cause in causes])
    save_figures({"causes.png": picture(causes)}, out)
    return {cause.name: cause.row()[1] for cause in causes}


def picture(causes: list[Cause]) -> Figure:
    """The error that remains with each change."""
    figure, axes = new_axes("one thing changed at a time", "", "position error [m]", equal=False)
    errors = [cause.row()[1] for cause in causes]
    axes.barh([cause.name for cause in causes], errors, color=COLOURS["filter"])
    axes.invert_yaxis()
    return figure


if __name__ == "__main__":
    tyro.cli(main)
