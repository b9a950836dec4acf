"""The command line: thin, one function per command."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tyro.extras import SubcommandApp

from rbpf.errors import InputError

CONSOLE = Console(stderr=True)
APP, RUN, SIMULATE = SubcommandApp(), SubcommandApp(), SubcommandApp()


@dataclass(frozen=True)
class RangeBearingOptions:
    """Options of `rbpf run range-bearing`.

    Attributes:
        log: recording: a folder of an MRCLAM or MRPT log, or a Victoria Park graph.
        out: folder for the results.
        particles: number of particles; by default as in the configuration.
        seed: of the random generator; by default as in the configuration.
        association: landmarks named by the log, or by maximum likelihood; by default as in the configuration.
        config: YAML file of settings, such as a former run's config.yaml.
        set: a setting as key=value, such as proposal.iterations=1 or noise.std_range_m=0.1.
        resume: go on from the checkpoint in the results' folder.
        batch: also solve for the batch optimum with GTSAM.
        threads: threads of the kernels; by default all.
    """

    log: tyro.conf.Positional[Path]
    out: Path = Path("run")
    particles: int | None = None
    seed: int | None = None
    association: Literal["known", "ml"] | None = None
    config: Path | None = None
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    batch: bool = True
    threads: int | None = None


@RUN.command(name="range-bearing")
def run_range_bearing(options: Annotated[RangeBearingOptions, tyro.conf.arg(name="")]) -> None:
    """Range-bearing SLAM over a robot's log (FastSLAM 2.0), beside the batch optimum of the same measurements."""
    import numba

    from rbpf.kernels import compile_once
    from rbpf.systems.range_bearing.settings import load_settings
    from rbpf.validation.range_bearing import finish_run, start_run

    given = {name: getattr(options, name) for name in ("particles", "seed", "association")}
    config = load_settings(options.config, options.set, {k: v for k, v in given.items() if v is not None})
    if options.threads is not None:
        if not 1 <= options.threads <= numba.config.NUMBA_NUM_THREADS:
            raise InputError(
                f"--threads must lie in 1..{numba.config.NUMBA_NUM_THREADS}, got {options.threads}"
            )
        numba.set_num_threads(options.threads)
    compile_once(lambda: CONSOLE.print("compiling the kernels, which takes a minute and is done once …"))
    with _progress() as bar:
        task = bar.add_task("filtering", total=None)
        run = start_run(
            options.log,
            config,
            options.out,
            options.resume,
            lambda done, total: bar.update(task, completed=done, total=total),
        )
    if options.batch:
        CONSOLE.print("solving the batch problem with the same measurements …")
    entries = finish_run(run, options.log, options.out, options.batch)
    _print_summary(entries, options.out)


@SIMULATE.command(name="range-bearing")
def simulate_range_bearing(
    out: Path,
    seed: int = 0,
    spatial: tyro.conf.FlagCreatePairsOff[bool] = False,
    steps: int = 200,
    landmarks: int = 60,
) -> None:
    """A log of a robot among landmarks, with ground truth.

    Args:
        out: folder for the log.
        seed: of the random generator.
        spatial: six degrees of freedom instead of three.
        steps: number of steps.
        landmarks: number of landmarks.
    """
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    simulate_robot(RobotWorld(steps, landmarks, spatial), out, seed)
    CONSOLE.print(f"wrote {out}")


@APP.command(name="demo")
def demo(out: Path = Path("demo")) -> None:
    """Simulate a robot's log, filter it, score it and leave plots.

    Args:
        out: folder for the log and the results.
    """
    simulate_range_bearing(out / "log")
    run_range_bearing(RangeBearingOptions(out / "log", out / "run"))


APP.command(RUN, name="run")
APP.command(SIMULATE, name="simulate")


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, runs the command; bad input becomes one sentence and exit code 2."""
    try:
        APP.cli(prog="rbpf", description="Rao-Blackwellised particle filters for SLAM.", args=arguments)
    except InputError as error:
        print(f"rbpf: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rbpf: stopped; --resume goes on from the last checkpoint", file=sys.stderr)
        return 130
    return 0


def _progress() -> Progress:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=CONSOLE)


def _print_summary(entries: dict[str, object], out: Path) -> None:
    for name, value in entries.items():
        CONSOLE.print(f"{name:>34}  {value:.6g}" if isinstance(value, float) else f"{name:>34}  {value}")
    CONSOLE.print(f"results, pictures and report.html are in {out}")


if __name__ == "__main__":
    sys.exit(main())
