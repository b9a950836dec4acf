"""What a comparison of a run with something else consists of, in memory and in JSON."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.files import write_text
from rbpf.validation.consistency.statistic import Statistic

_PREFIX = "validation_"


@dataclass(frozen=True)
class Comparison:
    """One comparison of a run.

    Attributes:
        against: with what.
        accuracy: how good the run is by it, half a sentence: "the path is … m from …".
        figures: numbers by name.
        statistics: of the filter's honesty.
        pictures: files in the run's folder.
    """

    against: str
    accuracy: str
    figures: dict[str, Any]
    statistics: list[Statistic] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)


def write_comparison(folder: Path, comparison: Comparison) -> Path:
    """Writes `validation_NAME.json`; returns its path."""
    entries = {
        "against": comparison.against,
        "accuracy": comparison.accuracy,
        "figures": comparison.figures,
        "statistics": [statistic.entries() for statistic in comparison.statistics],
        "pictures": comparison.pictures,
    }
    path = folder / f"{_PREFIX}{comparison.against}.json"
    write_text(path, json.dumps(entries, indent=2, allow_nan=False) + "\n")
    return path


def clear_comparisons(folder: Path) -> None:
    """Removes the comparisons of an earlier run from a folder, with their pictures."""
    for path in folder.glob(f"{_PREFIX}*.json"):
        against = path.stem.removeprefix(_PREFIX)
        for picture in folder.glob(f"{against}_*.png"):
            picture.unlink()
        path.unlink()


def read_comparisons(folder: Path) -> list[Comparison]:
    """All comparisons that a folder holds, in order of their names.

    Raises:
        InputError: a file is not one.
    """
    return [_read(path) for path in sorted(folder.glob(f"{_PREFIX}*.json"))]


def _read(path: Path) -> Comparison:
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return Comparison(
            str(entries["against"]),
            str(entries["accuracy"]),
            dict(entries["figures"]),
            [Statistic.of_entries(item) for item in entries["statistics"]],
            [Path(name).name for name in entries["pictures"]],
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a comparison of this version of rbpf: delete it and validate again"
        ) from error
