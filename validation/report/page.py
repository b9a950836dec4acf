"""One page per run, from the files in its folder: verdict, comparisons with their pictures, the run's own figures.

A video stays a file beside the page.
"""

import base64
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.files import write_text
from rbpf.runs.plots import World, tracking_losses
from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.comparison import (
    Comparison,
    compare_with_itself,
    independent_names,
    noise_advice,
    read_comparisons,
)
from rbpf.validation.consistency.statistic import Statistic
from rbpf.validation.consistency.verdict import PathGrade, Verdict, grade_path, judge

PAGE = "report.html"
VIDEO = "annotated.mp4"

_SAME = {"groundtruth_path.png": "path.png", "groundtruth_error.png": "error.png"}
"""Pictures of a comparison that show what one of the run's own does."""


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    accuracy: str = ""
    statistics: list[dict[str, str]] = field(default_factory=list)
    entries: list[tuple[str, str]] = field(default_factory=list)
    images: list[tuple[str, str]] = field(default_factory=list)


def write_report(folder: Path, problems: list[str] | None = None) -> Verdict:
    """Builds `report.html` of a run from the files in its folder; returns the verdict that stands on top.

    `problems` are what else has to be said, one sentence each.

    Raises:
        InputError: the folder is not that of a run.
    """
    from jinja2 import Environment, PackageLoader, select_autoescape

    record, problems = RunFolder.open(folder), list(problems or ())
    # Comparisons in the folder, the truth's first, and the run's own statistics.
    comparisons: list[Comparison] = []
    try:
        comparisons = sorted(read_comparisons(folder), key=lambda c: (c.against != "groundtruth", c.against))
    except InputError as error:
        problems.append(f"{error}.")
    try:
        comparisons.append(compare_with_itself(record))
    except InputError as error:
        problems.append(f"{error}.")
    verdict = verdict_of(record, comparisons)
    drawn = {name for comparison in comparisons for name in comparison.pictures}
    drawn |= {own for name, own in _SAME.items() if name in drawn}
    own = [path.name for path in sorted(folder.glob("*.png")) if path.name not in drawn]
    try:
        world = World.of(record)
    except InputError:
        world = World()  # the truth is damaged, which is said among the problems
    titles = {"groundtruth": "Against the ground truth", "itself": "Innovations"}
    sections = [
        Section(
            titles.get(comparison.against, f"Against {comparison.against}"),
            comparison.accuracy,
            [_row(statistic) for statistic in comparison.statistics],
            [] if comparison.against == "itself" else _flat(comparison.figures),
            _images(folder, comparison.pictures),
        )
        for comparison in comparisons
    ]
    sections.append(Section("The run", entries=_flat(record.summary), images=_images(folder, own)))
    video = VIDEO if (folder / VIDEO).is_file() else None
    loader = PackageLoader("rbpf.validation.report", "templates")
    template = Environment(loader=loader, autoescape=select_autoescape()).get_template(PAGE)
    page = template.render(
        title=record.name, verdict=verdict, world=world, problems=problems, sections=sections, video=video
    )
    write_text(folder / PAGE, page)
    return verdict


def verdict_of(record: RunFolder, comparisons: list[Comparison]) -> Verdict:
    """The verdict on a run from all its comparisons, the truth's first and its own statistics among them."""
    statistics = [statistic for comparison in comparisons for statistic in comparison.statistics]
    by_name = {comparison.against: comparison for comparison in comparisons if comparison.accuracy}
    accuracy, figures, key = PathGrade().sentence, {}, "position_rmse_m"
    if "groundtruth" in by_name:
        accuracy, figures = by_name["groundtruth"].accuracy, by_name["groundtruth"].figures
    elif by_name:
        best = by_name.get("relations", by_name.get("gtsam", next(iter(by_name.values()))))
        accuracy = best.accuracy
        if best.against != "relations":
            accuracy += " How far it is from the truth is not known."
        figures, key = best.figures, "filter_minus_batch_rmse_m"
    try:
        lost, frames = tracking_losses(record)
    except InputError:
        lost, frames = None, 0
    path = grade_path(accuracy, figures.get(key), figures.get("path_spread_m"), lost, frames)
    verdict = judge(statistics, independent_names(comparisons), path)
    return replace(verdict, advice=noise_advice(record, statistics))


def _row(statistic: Statistic) -> dict[str, str]:
    unit = 100.0 if statistic.kind == "share" else 1.0
    sign = " %" if statistic.kind == "share" else ""

    def shown(value: float) -> str:
        return f"{unit * value:.3g}{sign}"

    low, high = statistic.zone
    zone = f"up to {shown(high)}" if low < -1e9 else f"{shown(low)} to {shown(high)}"
    return {
        "name": statistic.name,
        "value": shown(statistic.value),
        "interval": f"{shown(statistic.low)} to {shown(statistic.high)}",
        "zone": zone,
        "samples": f"{statistic.samples:.0f}",
        "outcome": statistic.outcome,
    }


def _images(folder: Path, names: list[str]) -> list[tuple[str, str]]:
    # A link may show what its maker must not see of the disk of whoever opens the run.
    inside = folder.resolve()
    there = [name for name in names if (folder / name).is_file() and (folder / name).resolve().is_relative_to(inside)]
    return [(Path(name).stem, base64.b64encode((folder / name).read_bytes()).decode()) for name in there]


def _flat(entries: dict[str, Any]) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in entries.items():
        if isinstance(value, dict):
            rows.extend((f"{name}.{inner}", _shown(item)) for inner, item in value.items())
        else:
            rows.append((name, _shown(value)))
    return rows


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
