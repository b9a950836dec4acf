"""Commands about finished runs: compare them with something, build their page, export them, sweep over settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rbpf.cli.options import Printed, Text, Where
from rbpf.cli.showing import answer, progress, waiting
from rbpf.errors import InputError
from rbpf.ranges import Count, Range

if TYPE_CHECKING:
    from rbpf.validation.consistency.verdict import Verdict

Format = Literal["tum", "kitti", "ply", "colmap", "rerun", "npz"]


@dataclass(frozen=True, kw_only=True)
class ValidateOptions(Printed):
    """Options of `rbpf validate`."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder that `rbpf run` left.
    #: ground truth of the recording, batch optimum of the same measurements, or a reconstruction.
    against: Literal["groundtruth", "gtsam", "colmap"] = "groundtruth"
    #: in their place, a file of relations between poses (t1 t2 x y z roll pitch yaw) that are known; by default none.
    relations: Where = None
    path: Where = None  #: in their place, another path of the same recording, in TUM format; by default none.
    out: Where = None  #: a further folder for the JSON, which is always written into the run's own; by default none.


def validate(options: Annotated[ValidateOptions, tyro.conf.arg(name="")]) -> None:
    """Compare a run with the truth, an optimum or another path: JSON, pictures, and the lights on top of its report."""
    from rbpf.validation.consistency.comparison import read_comparisons
    from rbpf.validation.report.validate import validate as compare

    if options.relations is not None and options.path is not None:
        raise InputError("a run is compared with one thing at a time: leave out --relations or --path")
    file = options.relations or options.path
    against = options.against if file is None else "path" if options.relations is None else "relations"
    with waiting(f"comparing with {file or against} …"):
        verdict = compare(options.run, against, options.out, file)
    # The page's first sentence is about the truth where there is one; who asked for another comparison wants that one.
    asked = [c.accuracy for c in read_comparisons(options.run) if c.against == against]
    _answer(verdict, options.run, options.json, *(found for found in asked if found not in verdict.path.sentence))


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Printed):
    """Options of `rbpf report`."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder that `rbpf run` left.


def report(options: Annotated[ReportOptions, tyro.conf.arg(name="")]) -> None:
    """Build the report of a run again, from the files in its folder."""
    from rbpf.validation.report.page import write_report

    _answer(write_report(options.run), options.run, options.json)


def _answer(verdict: "Verdict", run: Path, as_json: bool, *first: str) -> None:
    page, said = run / "report.html", [*first, *verdict.said]
    entries = {"path_grade": verdict.path.grade, "trust": verdict.trust, "sentences": said, "report": str(page)}
    answer(entries, as_json, *said, f"the page is {page}")


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Printed):
    """Options of `rbpf export`."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder that `rbpf run` left.
    #: one or several: trajectory as TUM or KITTI, map and path as PLY, a COLMAP model, a Rerun recording, everything
    #: as one NumPy archive.
    format: tuple[Format, ...]
    out: Where = None  #: folder for the files; by default RUN/export.


def export(options: Annotated[ExportOptions, tyro.conf.arg(name="")]) -> None:
    """Write a run in the formats of other programs."""
    from rbpf.validation.exports import export_run

    out = options.out or options.run / "export"
    paths = [str(path) for path in export_run(options.run, options.format, out)]
    answer({"files": paths}, options.json, *(f"wrote {path}" for path in paths))


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Printed):
    """Options of `rbpf sweep`."""

    #: YAML file with system, sequences, particles, seeds, options and settings.
    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    out: Path = Path("sweep")  #: folder for the rows and the table; what is finished there is not computed again.
    workers: Annotated[int, Range(ge=-1, le=4096)] = -1  #: processes of this machine; -1 is one per core.
    scheduler: Text = None  #: address of a Dask scheduler (tcp://HOST:PORT) whose workers run instead; by default none.


def sweep(options: Annotated[SweepOptions, tyro.conf.arg(name="")]) -> None:
    """Run particles × seeds × sequences × options in parallel, to one table; call it again to go on."""
    from rbpf.validation.sweep.plan import read_plan
    from rbpf.validation.sweep.sweep import TABLE
    from rbpf.validation.sweep.sweep import sweep as run_all

    if options.workers == 0 or options.workers < -1:
        raise InputError(f"--workers must be at least 1, or -1 for one per core, got {options.workers}")
    jobs = read_plan(options.config)
    with progress() as bar:
        rows = run_all(jobs, options.out, options.workers, options.scheduler, bar("running"))
    failures = [row["failure"] for row in rows if "failure" in row]
    path = options.out / TABLE
    entries = {"runs": len(rows), "failed": len(failures), "table": str(path)}
    answer(entries, options.json, f"{len(rows)} runs are in {path}")
    if failures:
        raise InputError(f"{len(failures)} of {len(rows)} runs were not possible, the first: {failures[0]}")


@dataclass(frozen=True, kw_only=True)
class CompareOptions(Printed):
    """Options of `rbpf compare`."""

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]  #: folder that `rbpf run` left.
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]  #: another one of the same recording.
    seeds: Count = 5  #: runs of each, from which the error is estimated; parts of the draws where it is done in batch.
    workers: Annotated[int, Range(ge=-1, le=4096)] = -1  #: processes; -1 is one per core.


def compare(options: Annotated[CompareOptions, tyro.conf.arg(name="")]) -> None:
    """Which of two runs' settings explains their recording better: difference of log-evidence, with its error."""
    from rbpf.validation.consistency.model_comparison import compare_runs

    a, b = options.run_a, options.run_b
    with progress() as bar:
        found = compare_runs(a, b, options.seeds, options.workers, bar("filtering"))
    sentence = found.sentence(str(a), str(b))
    entries = {"difference": found.difference, "error": found.error, "sentence": sentence}
    answer(entries, options.json, sentence)
