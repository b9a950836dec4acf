"""Files that a run leaves: whole or not there at all; tables, maps and summaries."""

import csv
import json
import os
import resource
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from rbpf import gaussian
from rbpf.core.checkpoint import save_arrays
from rbpf.errors import InputError
from rbpf.systems.map_estimate import MapEstimate


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary place beside a file, which gets the file's name when everything is written.

    Nothing stays of what fails half way, and a file that was there before stays as it was.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """
    temporary = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        reason = (error.strerror or str(error)).strip().splitlines()[0]
        raise InputError(f"{path} cannot be written: {reason}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def prepare_folder(out: Path) -> None:
    """Makes a run's folder.

    Raises:
        InputError: there is a file of that name, or the folder cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file: name a folder for the results")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {out} for the results: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """Writes a whole file or none; raises InputError where the place cannot be written to, or the disk is full."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_summary(out: Path, entries: Mapping[str, Any]) -> None:
    """summary.json."""
    write_text(out / "summary.json", json.dumps(entries, indent=2, allow_nan=False) + "\n")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A comma-separated table with a header line."""
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, buffer.getvalue())


def write_map(out: Path, summary: MapEstimate, facts: Mapping[str, np.ndarray] | None = None) -> None:
    """map.npz and map.csv.

    Args:
        out: the run's folder.
        summary: M landmarks.
        facts: further columns by name, (M,) each.
    """
    facts = facts or {}
    save_arrays(out / "map.npz", {"id": summary.ids, "mean": summary.mean, "cov": summary.cov, **facts})
    dim = summary.mean.shape[1]
    axes = "xyz"[:dim]
    cov_names = [f"c{axes[a]}{axes[b]}" for a in range(dim) for b in range(a + 1)]
    packed = gaussian.pack(summary.cov)
    columns = [column.tolist() for column in facts.values()]
    rows = (
        [name, *mean, *cov, *more]
        for name, mean, cov, *more in zip(
            summary.ids, summary.mean.tolist(), packed.tolist(), *columns, strict=True
        )
    )
    write_csv(out / "map.csv", ["id", *(f"{axis}_m" for axis in axes), *cov_names, *facts], rows)


def milliseconds_per_frame(seconds: np.ndarray) -> dict[str, float]:
    """Median and 95th percentile of times (T,) [s], in ms."""
    milliseconds = seconds * 1e3
    return {
        "median": round(float(np.median(milliseconds)), 3),
        "p95": round(float(np.percentile(milliseconds, 95)), 3),
    }


def nis_ratio(nis: np.ndarray, rows: np.ndarray) -> float | None:
    """NIS per degree of freedom over all steps; None without a linearised innovation."""
    used = np.isfinite(nis) & (rows > 0)
    return float(nis[used].sum() / rows[used].sum()) if used.any() else None


def peak_memory_mb() -> float:
    """Largest resident size of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)
