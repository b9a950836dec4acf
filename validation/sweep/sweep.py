"""Runs a sweep in parallel, on this machine or on a cluster, and keeps every finished run.

rows.jsonl   one line per finished run, written as soon as it is done; a sweep that is called again computes the rest
table.csv    one row per run, one column per figure: CSV, because pandas, polars, R and spreadsheets read it and
             Parquet would take a library of 170 MB for a table of some hundred rows
"""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder, write_csv
from rbpf.validation.sweep.plan import Job
from rbpf.validation.sweep.systems import system_named

ROWS = "rows.jsonl"
TABLE = "table.csv"
SECONDS = 20
"""That a scheduler may take to answer."""
Row = dict[str, Any]


def sweep(
    jobs: Sequence[Job],
    out: Path,
    workers: int = -1,
    scheduler: str | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Runs what is not done yet and writes the table; returns the rows in the order of the jobs.

    A run that was not possible has its `failure` in words.

    Args:
        jobs: of `rbpf.validation.sweep.plan.read_plan`.
        out: folder for rows and table.
        workers: processes of this machine; −1 for one per core.
        scheduler: address of a Dask scheduler, whose workers run the jobs instead; they need the same paths.
        on_run: called with the runs done and their number.

    Raises:
        InputError: the folder cannot be written, a former row is damaged or no scheduler answers.
    """
    prepare_folder(out)
    done = read_rows(out / ROWS)
    todo = [job for job in jobs if job.key not in done]
    told = on_run or (lambda _done, _total: None)
    told(len(jobs) - len(todo), len(jobs))
    try:
        with (out / ROWS).open("a", encoding="utf-8") as file:
            for row in _results(todo, workers, scheduler):
                file.write(json.dumps(row) + "\n")
                file.flush()
                os.fsync(file.fileno())
                done[row["key"]] = row
                told(sum(job.key in done for job in jobs), len(jobs))
    finally:
        rows = [job.facts() | done[job.key]["figures"] for job in jobs if job.key in done]
        write_table(out / TABLE, rows)
    return rows


def read_rows(path: Path) -> dict[str, Row]:
    """Finished runs by their keys; a last line that was cut off when the program was stopped is dropped.

    Raises:
        InputError: another line is damaged.
    """
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


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """One line per row; a figure that a run does not have is left empty."""
    flat = [_flat(row) for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    write_csv(path, names, [[row.get(name, "") for name in names] for row in flat])


def run_job(job: Job) -> Row:
    """One run, with one thread: the processes keep the machine busy."""
    import numba

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        sequence = {name: Path(path) for name, path in job.sequence}
        figures = system_named(job.system).run(sequence, job.settings, job.given)
    except InputError as error:
        figures = {"failure": str(error)}
    finally:
        numba.set_num_threads(threads)
    return {"key": job.key, "figures": figures}


def _results(jobs: Sequence[Job], workers: int, scheduler: str | None) -> Iterator[Row]:
    """Rows as they are done."""
    from joblib import Parallel, delayed, parallel_config

    if not jobs:
        return
    with _cluster(scheduler):
        backend = {"n_jobs": workers} if scheduler is None else {"backend": "dask"}
        with parallel_config(**backend):
            parallel = Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all")
            with closing(parallel(delayed(run_job)(job) for job in jobs)) as rows:
                yield from rows


@contextmanager
def _cluster(scheduler: str | None) -> Iterator[None]:
    """A connection to a Dask scheduler, if one is named."""
    if scheduler is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError("a sweep on a cluster needs Dask: pip install 'rbpf[cluster]'") from error
    try:
        client = Client(scheduler, timeout=SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no Dask scheduler answers at {scheduler} within {SECONDS} s: {error}") from error
    with client:
        yield


def _flat(row: Row) -> Row:
    out: Row = {}
    for name, value in row.items():
        if isinstance(value, dict):
            out.update({f"{name}.{inner}": item for inner, item in value.items()})
        else:
            out[name] = json.dumps(value) if isinstance(value, list) else value
    return out
