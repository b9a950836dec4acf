"""A run folder of any system, read back: what a comparison and a report are made of.

Each part is read when it is asked for, so that a folder that lacks one still has the others.
"""

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.checkpoint import load_arrays
from rbpf.errors import InputError
from rbpf.systems.map_estimate import MapEstimate, map_of
from rbpf.systems.plain_yaml import read_plain_yaml
from rbpf.validation.run_files import FilteredPath, RunTruth, read_path, read_truth

MOST_BYTES = 1 << 30
"""No file of a run folder is larger."""


@dataclass(frozen=True)
class RunRecord:
    """A run folder.

    Attributes:
        folder: where it lies.
        config: the entries of config.yaml.
        summary: the entries of summary.json.
    """

    folder: Path
    config: dict[str, Any]
    summary: dict[str, Any]

    @property
    def system(self) -> str:
        """Which system made it."""
        return str(self.config.get("system", ""))

    @property
    def name(self) -> str:
        """Of the recording."""
        return str(self.summary.get("recording", self.folder.name))

    def path(self) -> FilteredPath:
        """The filtered poses; errors as `read_path`."""
        return read_path(self.folder)

    def truth(self) -> RunTruth:
        """The ground truth at the run's steps; errors as `read_truth`."""
        return read_truth(self.folder, self.path())

    def map(self) -> MapEstimate:
        """The landmarks that are points; those whose depth is not known are left out.

        Raises:
            InputError: map.npz is missing or damaged.
        """
        arrays = load_arrays(self.folder / "map.npz")
        return map_of(self.folder / "map.npz", arrays)

    def table(self, name: str) -> dict[str, np.ndarray]:
        """A table of numbers by its columns' names: diagnostics.csv, timings.csv.

        Raises:
            InputError: it is missing, or holds something else.
        """
        path = self.folder / name
        with _opened(path) as file:
            rows = list(csv.reader(file))
        if not rows or any(len(row) != len(rows[0]) for row in rows):
            raise InputError(f"{path}: expected a table whose rows have as many cells as its header")
        try:
            values = np.array(rows[1:], dtype=float).reshape(len(rows) - 1, len(rows[0]))
        except ValueError as error:
            raise InputError(f"{path}: expected numbers below the header: {error}") from error
        return dict(zip(rows[0], values.T, strict=True))


def open_run(folder: Path) -> RunRecord:
    """Opens a run folder.

    Raises:
        InputError: it is not one, or its config.yaml or summary.json is damaged.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: expected the folder of a run, there is no such folder")
    for name in ("config.yaml", "summary.json"):
        if not (folder / name).is_file():
            raise InputError(f"{folder} has no {name}: expected the folder that a finished `rbpf run` left")
    config = _mapping(folder / "config.yaml", read_plain_yaml(folder / "config.yaml"))
    with _opened(folder / "summary.json") as file:
        summary = _mapping(folder / "summary.json", _json(folder / "summary.json", file.read()))
    return RunRecord(folder, config, summary)


def _json(path: Path, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged: {' '.join(str(error).split())}") from error


def _mapping(path: Path, found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise InputError(f"{path} is damaged: expected names with values")
    return {str(name): value for name, value in found.items()}


def _opened(path: Path) -> Any:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path} is larger than any file of a run")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    from io import StringIO

    return StringIO(text)
