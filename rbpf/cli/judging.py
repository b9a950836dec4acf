"""Commands about finished runs: compare them, build their report, export them, sweep over settings."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rbpf.cli.options import Printed, Text, Where
from rbpf.cli.showing import CONSOLE, answer, progress, table
from rbpf.errors import InputError
from rbpf.ranges import Count, NotNegative, Range

if TYPE_CHECKING:
    from rbpf.validation.consistency.comparison import Verdict

Format = Literal["tum", "kitti", "ply", "colmap", "rerun", "npz"]


@dataclass(frozen=True, kw_only=True)
class Validate(Printed):
    """Compare a run with the truth, an optimum or another path: writes JSON, plots, and the lights on top of its report."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder written by `rbpf run`.
    #: the recording's ground truth, the batch optimum of the same measurements, or a reconstruction of the images.
    against: Literal["groundtruth", "gtsam", "colmap"] = "groundtruth"
    #: instead, a file of known relative poses (t1 t2 x y z roll pitch yaw); by default none.
    relations: Where = None
    path: Where = None  #: instead, another path of the same recording, in TUM format; by default none.
    truth_std_m: NotNegative = 0.0  #: standard deviation of the ground truth's positions, per axis, m.
    truth_std_deg: NotNegative = 0.0  #: standard deviation of its rotations, per axis, degrees.
    out: Where = None  #: further folder for the JSON, which is always written to the run's folder; by default none.

    def __call__(self) -> None:
        from rbpf.runs.truth import Precision
        from rbpf.validation.consistency.comparison import read_comparisons
        from rbpf.validation.finish import validate as compare

        if self.relations is not None and self.path is not None:
            raise InputError("a run is compared with one thing at a time: leave out --relations or --path")
        file = self.relations or self.path
        against = self.against if file is None else "path" if self.relations is None else "relations"
        truth = Precision(self.truth_std_m, math.radians(self.truth_std_deg))
        if any(truth) and against != "groundtruth":
            raise InputError(f"--truth-std-m and --truth-std-deg are of the ground truth, not of {file or against}")
        with CONSOLE.status(f"comparing with {file or against} …"):
            verdict = compare(self.run, against, self.out, file, truth)
        # The page's first sentence is about the truth if there is one; here that of the requested comparison is shown.
        asked = [c.accuracy for c in read_comparisons(self.run)[0] if c.against == against]
        _answer(verdict, self.run, self.json, *(found for found in asked if found not in verdict.path.sentence))


@dataclass(frozen=True, kw_only=True)
class Report(Printed):
    """Rebuild the report of a run from the files in its folder."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder written by `rbpf run`.

    def __call__(self) -> None:
        from rbpf.validation.report.page import write_report

        _answer(write_report(self.run), self.run, self.json)


@dataclass(frozen=True, kw_only=True)
class Plot(Printed):
    """Plot a run, or paths, errors and consistency of several runs together, with a table of figures."""

    #: folders written by `rbpf run`, of one recording.
    runs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN")]
    out: Path = Path("plots")  #: folder for the plots.
    format: tuple[Literal["png", "pdf", "svg"], ...] = ("png",)  #: one or several; pdf and svg are vector graphics.

    def __call__(self) -> None:
        from rbpf.runs.files import prepare_folder
        from rbpf.runs.plots import draw_run
        from rbpf.runs.reading import RunFolder
        from rbpf.validation.report.comparison_pictures import draw_beside

        if not self.runs:
            raise InputError("name one run to draw, or several to draw together: rbpf plot RUN_A RUN_B")
        found = [RunFolder.open(run) for run in self.runs]
        prepare_folder(self.out)
        one = len(found) == 1
        names = draw_run(found[0], self.out, self.format) if one else draw_beside(found, self.out, self.format)
        entries = {str(run.folder): {n: run.summary[n] for n in _BESIDE if n in run.summary} for run in found}
        lines = [line for run, figures in entries.items() for line in (run, *table(figures, 28))]
        answer({"runs": entries, "files": names}, self.json, *lines, f"wrote {', '.join(names)} into {self.out}")


#: Entries of summary.json by which runs are compared.
_BESIDE = (
    "frames", "particles", "position_rmse_m", "ate_rmse_m", "ate_sim3_rmse_m", "filter_minus_batch_rmse_m", "lost_frames",
    "nis_per_dof", "log_evidence", "ms_per_frame",
)  # fmt: skip


def _answer(verdict: "Verdict", run: Path, as_json: bool, *first: str) -> None:
    page, said = run / "report.html", [*first, *verdict.said]
    entries = {"path_grade": verdict.path.grade, "trust": verdict.trust, "sentences": said, "report": str(page)}
    answer(entries, as_json, *said, f"the page is {page}")


@dataclass(frozen=True, kw_only=True)
class Export(Printed):
    """Export a run to the formats of other programs."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]  #: folder written by `rbpf run`.
    #: one or several: trajectory as TUM or KITTI, map and path as PLY, a COLMAP model, a Rerun recording, everything
    #: as one NumPy archive.
    format: tuple[Format, ...]
    out: Where = None  #: folder for the files; by default RUN/export.

    def __call__(self) -> None:
        from rbpf.validation.exports import export_run

        paths = [str(path) for path in export_run(self.run, self.format, self.out or self.run / "export")]
        answer({"files": paths}, self.json, *(f"wrote {path}" for path in paths))


def _require_workers(workers: int) -> None:
    if workers == 0:
        raise InputError("--workers must be at least 1, or -1 for one per core, got 0")


@dataclass(frozen=True, kw_only=True)
class Sweep(Printed):
    """Run particles × seeds × sequences × options in parallel, into one table; repeat the command to continue."""

    #: YAML file with system, sequences, particles, seeds, options and settings.
    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    out: Path = Path("sweep")  #: folder for the rows and the table; runs finished there are not repeated.
    workers: Annotated[int, Range(ge=-1, le=4096)] = -1  #: number of processes on this machine; -1 is one per core.
    scheduler: Text = None  #: address of a Dask scheduler (tcp://HOST:PORT) whose workers run instead; by default none.

    def __call__(self) -> None:
        from rbpf.validation.sweep import TABLE, read_plan
        from rbpf.validation.sweep import sweep as run_all

        _require_workers(self.workers)
        jobs = read_plan(self.config)
        with progress() as bar:
            rows = run_all(jobs, self.out, self.workers, self.scheduler, bar("running"))
        failures = [row["failure"] for row in rows if "failure" in row]
        path = self.out / TABLE
        entries = {"runs": len(rows), "failed": len(failures), "table": str(path)}
        answer(entries, self.json, f"{len(rows)} runs are in {path}")
        if failures:
            raise InputError(f"{len(failures)} of {len(rows)} runs were not possible, the first: {failures[0]}")


@dataclass(frozen=True, kw_only=True)
class Compare(Printed):
    """Which of two runs' settings explain their recording better: difference of log-evidence, with its error."""

    run_a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]  #: folder written by `rbpf run`.
    run_b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]  #: another one of the same recording.
    seeds: Count = 5  #: repeated runs of each, which give the error; in batch, parts of the samples.
    workers: Annotated[int, Range(ge=-1, le=4096)] = -1  #: number of processes; -1 is one per core.

    def __call__(self) -> None:
        from rbpf.validation.consistency.model_comparison import compare_runs

        _require_workers(self.workers)
        a, b = self.run_a, self.run_b
        with progress() as bar:
            found = compare_runs(a, b, self.seeds, self.workers, bar("filtering"))
        sentence = found.sentence(str(a), str(b))
        answer({"difference": found.difference, "error": found.error, "sentence": sentence}, self.json, sentence)
