"""Sweeps: particles × seeds × sequences × options from a YAML file, run in parallel on this machine or on a cluster.

The file and the results are described in docs/how_to/sweep.md.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import msgspec

from rbpf import __version__
from rbpf.errors import InputError
from rbpf.runs.files import OnDone, prepare_folder, write_csv
from rbpf.runs.folder import summarise
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import SYSTEMS, filter_recording
from rbpf.runs.run import Run
from rbpf.runs.trajectory import in_space
from rbpf.sensors.readers.yaml_files import read_plain_yaml
from rbpf.systems.settings import load_settings
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.metrics.scores import ODOMETRY_PREFIX, score_estimate

ROWS = "rows.jsonl"
TABLE = "table.csv"
SECONDS = 20  #: Timeout of a scheduler's answer.
MOST_RUNS = 100_000
Value = str | int | float | bool | None
Row = dict[str, Any]
Named = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class SweepFile:
    """Content of the YAML file."""

    system: str  #: name of the system.
    sequences: list[str | dict[str, str]]  #: paths, or mappings of the system's fields to paths.
    particles: list[int] = field(default_factory=list)  #: numbers of particles; empty for the system's default.
    seeds: int | list[int] = 1  #: number of seeds, or the seeds.
    #: named options, each a mapping of settings.
    options: dict[str, dict[str, Value]] = field(default_factory=lambda: {"as it is": {}})
    settings: dict[str, Value] = field(default_factory=dict)  #: settings of all runs.


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    system: str  #: name of its system.
    sequence: Named  #: the system's fields and their paths, as (name, path).
    option: str  #: name of the option.
    settings: tuple[str, ...]  #: as key=value, the option's after those of all runs.
    particles: int | None  #: number of particles; None for the system's default.
    seed: int  #: of the filter.

    @property
    def key(self) -> str:
        """Name of the run, which is the same in repeated calls of the program."""
        facts = [__version__, self.system, self.sequence, self.settings, self.particles, self.seed]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]

    @property
    def given(self) -> dict[str, int]:
        """Settings by name."""
        return ({} if self.particles is None else {"particles": self.particles}) | {"seed": self.seed}

    def config(self) -> Any:
        """All settings of the run. Raises InputError: one is invalid."""
        return load_settings(SYSTEMS[self.system].config, self.system, None, self.settings, self.given)

    def facts(self) -> dict[str, Any]:
        """The first columns of its row in the table."""
        recording = dict(self.sequence)["recording"]
        return {"system": self.system, "sequence": recording, "option": self.option, **self.given}


def read_plan(path: Path) -> list[Job]:
    """All runs of a sweep, checked before the first one starts.

    Raises InputError: the file is unreadable, names something unknown, or a sequence is not there.
    """
    values = read_plain_yaml(path)
    if not isinstance(values, dict):
        raise InputError(f"{path} must hold system, sequences, … as `name: value`, one per line")
    known = SweepFile.__dataclass_fields__
    unknown = sorted(str(name) for name in values if name not in known)
    if unknown:
        raise InputError(f"{path}: there is no entry {unknown[0]!r} in a sweep; known here: {', '.join(known)}")
    try:
        return plan(msgspec.convert(values, SweepFile), path.parent, str(path))
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}") from error


def plan(file: SweepFile, folder: Path, where: str = "the sweep") -> list[Job]:
    """All runs of a sweep; paths are taken from a folder. Errors as `read_plan`."""
    if file.system not in SYSTEMS:
        raise InputError(f"a sweep runs one of the systems {', '.join(SYSTEMS)}, not {file.system!r}")
    sequences = [_sequence(given, SYSTEMS[file.system].paths, folder, where) for given in file.sequences]
    seeds: Sequence[int] = range(file.seeds) if isinstance(file.seeds, int) else file.seeds  # a range takes no memory
    for what, values in (("sequences", sequences), ("seeds", seeds), ("options", list(file.options))):
        if not values:
            raise InputError(f"{where}: {what} is empty, name at least one")
    sizes: list[int | None] = list(file.particles) or [None]
    if len(sequences) * len(sizes) * len(seeds) * len(file.options) > MOST_RUNS:
        raise InputError(f"{where} asks for more than {MOST_RUNS} runs: ask for fewer")
    settings = {
        name: tuple(f"{key}={'null' if value is None else value}" for key, value in (file.settings | option).items())
        for name, option in file.options.items()
    }
    jobs = [
        Job(file.system, sequence, name, settings[name], particles, seed)
        for sequence, name, particles, seed in product(sequences, file.options, sizes, seeds)
    ]
    for job in {(job.option, job.particles): job for job in jobs}.values():
        try:
            job.config()
        except InputError as error:
            raise InputError(f"{where}, option {job.option!r}: {error}") from error
    if len({job.key for job in jobs}) < len(jobs):
        raise InputError(f"{where} asks for the same run twice: two options, seeds or sequences are alike")
    return jobs


def _sequence(given: str | Mapping[str, str], fields: tuple[str, ...], folder: Path, where: str) -> Named:
    named = {"recording": given} if isinstance(given, str) else dict(given)
    if set(named) - set(fields) or "recording" not in named:
        raise InputError(f"{where}: a sequence has the entries {', '.join(fields)}, got {', '.join(named)}")
    paths = {name: folder / path for name, path in named.items()}
    for path in paths.values():
        if not path.exists():
            raise InputError(f"{where}: there is no sequence {path}")
    return tuple((name, str(path.resolve())) for name, path in sorted(paths.items()))


def sweep(
    jobs: Sequence[Job], out: Path, workers: int = -1, scheduler: str | None = None, on_run: OnDone | None = None
) -> list[Row]:
    """Runs the jobs of `read_plan` that are not done yet, writes rows and table; returns the rows in the order of the jobs.

    A run that was not possible has a message `failure`. `workers` are processes of this machine, −1 for one per
    core; `scheduler` is the address of a Dask scheduler whose workers run the jobs instead; they need the same paths.
    `on_run` is called with the runs done and their number.

    Raises InputError: the folder cannot be written, a former row is damaged or no scheduler answers.
    """
    prepare_folder(out)
    done = read_rows(out / ROWS)
    todo = [job for job in jobs if job.key not in done]
    report = on_run or (lambda _done, _total: None)
    report(len(jobs) - len(todo), len(jobs))
    try:
        with (out / ROWS).open("a", encoding="utf-8") as file:
            for row in _results(todo, workers, scheduler):
                file.write(json.dumps(row) + "\n")
                file.flush()
                os.fsync(file.fileno())
                done[row["key"]] = row
                report(sum(job.key in done for job in jobs), len(jobs))
    finally:
        rows = [job.facts() | done[job.key]["figures"] for job in jobs if job.key in done]
        # One line per row, nested figures as NAME.INNER; figures that a run does not have are empty.
        flat: list[Row] = [{} for _ in rows]
        for out_row, row in zip(flat, rows, strict=True):
            for name, value in row.items():
                if isinstance(value, dict):
                    out_row |= {f"{name}.{inner}": item for inner, item in value.items()}
                else:
                    out_row[name] = json.dumps(value) if isinstance(value, list) else value
        names = list(dict.fromkeys(name for row in flat for name in row))
        write_csv(out / TABLE, names, [[row.get(name, "") for name in names] for row in flat])
    return rows


def read_rows(path: Path) -> dict[str, Row]:
    """Finished runs by their keys; a last line that was cut off when the program was stopped is dropped."""
    if not path.exists():
        return {}
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    whole, _, cut = text.rpartition("\n")
    if cut:
        with path.open("r+", encoding="utf-8") as file:
            file.truncate(len((whole + "\n" if whole else "").encode()))
    rows = {}
    for number, line in enumerate(whole.splitlines(), 1):
        try:
            row = json.loads(line)
            rows[str(row["key"])] = {"key": str(row["key"]), "figures": dict(row["figures"])}
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"{path}, line {number} is not a finished run: delete the line") from error
    return rows


def run_job(job: Job) -> Row:
    """Performs one run with one thread, as the processes keep the machine busy."""
    import numba

    system, paths = SYSTEMS[job.system], {name: Path(path) for name, path in job.sequence}
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        figures = _figures(filter_recording(system.recording(*map(paths.get, system.paths)), job.config()))
    except InputError as error:
        figures = {"failure": str(error)}
    finally:
        numba.set_num_threads(threads)
    return {"key": job.key, "figures": figures}


def _figures(run: Run) -> Row:
    """A run's summary and scores, without writing them."""
    figures, log, truth = summarise(run), run.log, run.truth
    if truth is not None:
        anonymous, others = getattr(run.system.config, "association", "") == "ml", {}
        if "odometry" in log:
            others[ODOMETRY_PREFIX.get(run.system.name, "odometry_")] = in_space(log.stamps_ns, log["odometry"])
        figures |= score_estimate(PathAndMap.of_run(run), truth, anonymous, others)
    if truth is not None and truth.alignment == "none":
        # Mean over the steps, of d degrees of freedom; none if the truth is not in the filter's world.
        errors = whitened_errors(run.system.space, log.poses[truth.rows], log.covs[truth.rows], truth.poses)
        if (known := errors.ranks > 0).any():
            figures["pose_nees_mean"] = float(errors.nees[known].mean())
    return figures


def _results(jobs: Sequence[Job], workers: int, scheduler: str | None) -> Iterator[Row]:
    """Yields rows as they are completed."""
    from joblib import Parallel, delayed, parallel_config

    if not jobs:
        return
    backend: dict[str, Any] = {"n_jobs": workers}
    client: Any = nullcontext()
    if scheduler is not None:
        try:
            from distributed import Client

            backend, client = {"backend": "dask"}, Client(scheduler, timeout=SECONDS)
        except ImportError as error:
            raise InputError("a sweep on a cluster needs Dask: pip install 'rbpf[cluster]'") from error
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"no Dask scheduler answers at {scheduler} within {SECONDS} s: {error}") from error
    with client, parallel_config(**backend):
        parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all")
        with closing(parallel(delayed(run_job)(job) for job in jobs)) as rows:
            yield from rows
