"""Commands about finished runs: compare them with something, build their page, sweep over settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rbpf.cli.showing import CONSOLE, progress, told
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.validation.verdict import Verdict


@dataclass(frozen=True)
class ValidateOptions:
    """Options of `rbpf validate`.

    Attributes:
        run: folder that `rbpf run` left.
        against: ground truth of the recording, batch optimum of the same measurements, or a reconstruction.
        out: a further folder for the JSON; one is always written into the run's own.
    """

    run: tyro.conf.Positional[Path]
    against: Literal["groundtruth", "gtsam", "colmap"] = "groundtruth"
    out: Path | None = None


def validate(options: Annotated[ValidateOptions, tyro.conf.arg(name="")]) -> None:
    """Compare a run with the truth or an optimum: JSON, pictures, and two sentences on top of its report."""
    from rbpf.validation.validate import validate as compare

    _say(compare(options.run, options.against, options.out), options.run)


def report(run: tyro.conf.Positional[Path]) -> None:
    """Build the report of a run again, from the files in its folder.

    Args:
        run: folder that `rbpf run` left.
    """
    from rbpf.validation.report import write_report

    _say(write_report(run), run)


def _say(verdict: "Verdict", run: Path) -> None:
    for sentence in filter(None, (*verdict.sentences, verdict.advice)):
        CONSOLE.print(sentence, highlight=False)
    CONSOLE.print(f"the page is {run / 'report.html'}")


@dataclass(frozen=True)
class SweepOptions:
    """Options of `rbpf sweep`.

    Attributes:
        config: YAML file with system, sequences, particles, seeds, options and settings.
        out: folder for the rows and the table; what is finished there is not computed again.
        workers: processes of this machine; by default one per core.
        scheduler: address of a Dask scheduler (tcp://HOST:PORT) whose workers run instead.
    """

    config: tyro.conf.Positional[Path]
    out: Path = Path("sweep")
    workers: int = -1
    scheduler: str | None = None


def sweep(options: Annotated[SweepOptions, tyro.conf.arg(name="")]) -> None:
    """Run particles × seeds × sequences × options in parallel, to one table; call it again to go on."""
    from rbpf.validation.sweep import TABLE
    from rbpf.validation.sweep import sweep as run_all
    from rbpf.validation.sweep_plan import read_plan

    if options.workers == 0 or options.workers < -1:
        raise InputError(f"--workers must be at least 1, or -1 for one per core, got {options.workers}")
    jobs = read_plan(options.config)
    with progress() as bar:
        task = bar.add_task("running", total=len(jobs))
        rows = run_all(jobs, options.out, options.workers, options.scheduler, told(bar, task))
    CONSOLE.print(f"{len(rows)} runs are in {options.out / TABLE}")
    failures = [row["failure"] for row in rows if "failure" in row]
    if failures:
        raise InputError(f"{len(failures)} of {len(rows)} runs were not possible, the first: {failures[0]}")


def compare(
    run_a: tyro.conf.Positional[Path], run_b: tyro.conf.Positional[Path], seeds: int = 5, workers: int = -1
) -> None:
    """Which of two runs' settings explains their common recording better: difference of log-evidence, with its error.

    Args:
        run_a: folder that `rbpf run` left.
        run_b: another one of the same recording.
        seeds: runs of each, from which the error is told.
        workers: processes; by default one per core.
    """
    from rbpf.validation.model_comparison import compare_runs

    with progress() as bar:
        task = bar.add_task("filtering", total=2 * seeds)
        found = compare_runs(run_a, run_b, seeds, workers, told(bar, task))
    CONSOLE.print(found.sentence(str(run_a), str(run_b)), highlight=False)
