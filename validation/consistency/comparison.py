"""Comparisons of a run with something else, in memory and in JSON; and what a run says about itself by its innovations."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.files import write_text
from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.statistic import Statistic, motion_statistics, step_ratio

INNOVATIONS, RESIDUALS = "innovations of the measurements", "residuals of the batch optimum"

SETTINGS = {"mono": ("search", "noise_px")}
"""By system, where its configuration holds the one standard deviation of all measurements, px."""
_PREFIX = "validation_"


@dataclass(frozen=True)
class Comparison:
    """One comparison of a run."""

    against: str  #: with what.
    accuracy: str  #: how good the run is by it, half a sentence: "the path is … m from …".
    figures: dict[str, Any]  #: numbers by name.
    statistics: list[Statistic] = field(default_factory=list)  #: of the filter's consistency.
    pictures: list[str] = field(default_factory=list)  #: files in the run's folder.


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
    found = []
    for path in sorted(folder.glob(f"{_PREFIX}*.json")):
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
            comparison = Comparison(
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
        found.append(comparison)
    return found


def innovation_statistics(
    nis: np.ndarray, nis_dof: np.ndarray, correction: np.ndarray, cov_correction: np.ndarray
) -> list[Statistic]:
    """Innovations two-sided, and what they say about the motion.

    Without truth they find wrong noise of sensors and of the odometry, its bias, wrong associations and gross errors of
    a model. They do not find a filter whose particles agree on a wrong path that explains the measurements.

    `nis` (T,) with its degrees of freedom; corrections (T, r), (T, r, r) are those of `rbpf.core.diagnostics.Correction`,
    r = 0 where the system does not tell them.
    """
    innovations = step_ratio(INNOVATIONS, nis, nis_dof)
    motion = motion_statistics(correction, cov_correction) if correction.shape[1] else []
    return [*([] if innovations is None else [innovations]), *motion]


def compare_with_itself(record: RunFolder) -> Comparison:
    """A run's `innovation_statistics` as a comparison; its accuracy stays open.

    Raises:
        InputError: its diagnostics are missing or damaged.
    """
    table = record.table("diagnostics.csv")
    if not {"nis", "nis_dof"} <= table.keys():
        raise InputError(f"{record.folder / 'diagnostics.csv'} has no columns nis and nis_dof")
    correction, cov = np.zeros((0, 0)), np.zeros((0, 0, 0))
    try:
        path = record.path
        correction, cov = path.correction, path.cov_correction
    except InputError:
        pass  # a folder of another version has no such file; whoever needs the poses says so
    statistics = innovation_statistics(table["nis"], table["nis_dof"], correction, cov)
    figures = {statistic.name: statistic.value for statistic in statistics if np.isfinite(statistic.value)}
    return Comparison("itself", "", figures, statistics)


def independent_names(comparisons: Sequence[Comparison]) -> list[str]:
    """Names of the statistics that compare poses or landmarks with what the filter did not compute itself."""
    found = [s.name for comparison in comparisons if comparison.accuracy for s in comparison.statistics]
    return [name for name in found if name != RESIDUALS]


def noise_advice(record: RunFolder, statistics: list[Statistic]) -> str:
    """One sentence where innovations contradict the stated noise, with the noise that would make them right; else empty.

    With NIS per degree of freedom r and every measurement's standard deviation σ, innovations would be right at about
    σ √r (R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", 1970, in its simplest form:
    the noise of the measurements is taken to dominate what the filter expects). It is a hint for the next run, not an
    estimate: errors that repeat from step to step, such as a known point that is given a little beside itself, are in
    no innovation. Nothing is advised that would make a filter claim more which claims too much already.
    """
    daring = any(s.kind == "ratio" and s.low > s.zone[1] for s in statistics)
    found = [s for s in statistics if s.name == INNOVATIONS and s.outcome == "contradicts"]
    if not found or found[0].value <= 0.0 or (daring and found[0].value < 1.0):
        return ""
    factor = float(found[0].value) ** 0.5
    how = f"standard deviations of the measurements {factor:.2g} times as large"
    section, name = SETTINGS.get(record.system, ("", ""))
    settings: Any = record.config.get(section)
    value = settings.get(name) if isinstance(settings, dict) else None
    if isinstance(value, (int, float)) and value > 0:
        how = f"--set {section}.{name}={factor * value:.2g} in place of {value:g}"
    return (
        f"Innovations would be about as large as expected with {how}; judge such a run beside the truth or a batch "
        "optimum, because errors that repeat from step to step do not show in innovations."
    )
