"""The page of a run, report.html: made from the files in its folder, so that it can be made again without the recording.

On top what was run and two lights; then what comes of it: the video, which stays a file beside the page, the map to turn, each
comparison with its pictures, the run's own figures. The page needs no network.
"""

import base64
import shlex
import struct
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.files import write_text
from rbpf.runs.plots import FIGURES, VECTORS, World
from rbpf.runs.provenance import command_of
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import CONFIGS
from rbpf.validation.consistency import comparison as verdicts
from rbpf.validation.consistency.comparison import Comparison, Verdict
from rbpf.validation.report.scene import program, scene

PAGE = "report.html"
VIDEO = "annotated.mp4"
_TITLES = {
    "groundtruth": "Against the ground truth", "gtsam": "Against the batch optimum", "colmap": "Against COLMAP",
    "itself": "Innovations", "relations": "Against known relations", "path": "Against another path",
}  # fmt: skip
#: What a picture shows, by its name without its comparison's; those of a run itself say it in their docstrings.
_CAPTIONS = {
    "nees": "Normalised squared error of the pose: inside the band in 95 of 100 steps of an honest filter.",
    "landmarks": "Distances of the landmarks in σ, beside those of independent ones of an honest filter.",
    "map": "The map over what it is compared with.",
    "cloud": "Distances of the landmarks from the surface of COLMAP's points.",
    "ess": "Effective sample size and innovations, frame by frame.",
}
#: Paths beside the filter's own that figures of summary.json are told of, by the beginning of their names.
_OTHERS = {"odometry_": "odometry", "vo_": "odometry", "batch_": "batch", "final_": "final"}
_WORDS = {
    "position_rmse_m": "error of the positions, rms",
    "ate_rmse_m": "… after a rigid alignment",
    "ate_sim3_rmse_m": "… after an alignment with scale",
    "sim3_scale": "scale of that alignment",
    "rpe_translation_rmse_m": "error of the motion per frame",
    "rpe_rotation_rmse_deg": "error of the rotation per frame",
    "ms_per_frame": "time per frame",
}
#: Entries of summary.json that stand elsewhere on the page, or twice in the file.
_ELSEWHERE = {"system", "recording", "finished", "alignment", "path_rmse_m", "remarks", "problems", "failure"}
_UNITS = {"m": "m", "deg": "°", "px": "px", "mb": "MB", "ms": "ms", "s": "s", "rad": "rad", "frame": "ms"}
_WIDE = 1.9  #: A picture that is so many times as wide as high takes the width of the page.


class Picture(NamedTuple):
    """A picture of the page."""

    name: str
    data: str  #: PNG, as base64.
    caption: str
    wide: bool
    vectors: str  #: Name of the file beside the page with the same as vectors; "" where there is none.


def write_report(folder: Path, problems: list[str] | None = None) -> Verdict:
    """Builds `report.html` of a run from the files in its folder; returns the verdict that stands on top.

    `problems` are what else has to be said, one sentence each.
    """
    from jinja2 import Environment, PackageLoader, select_autoescape

    record, problems = RunFolder.open(folder), list(problems or ())
    # Comparisons in the folder, the truth's first, and the run's own statistics.
    comparisons: list[Comparison] = []
    try:
        comparisons = sorted(verdicts.read_comparisons(folder), key=lambda c: (c.against != "groundtruth", c.against))
    except InputError as error:
        problems.append(f"{error}.")
    try:
        comparisons.append(verdicts.compare_with_itself(record))
    except InputError as error:
        problems.append(f"{error}.")
    verdict = verdicts.verdict_of(record, comparisons)
    drawn = {name for comparison in comparisons for name in comparison.pictures}
    own = {path.name for path in folder.glob("*.png")} - drawn
    ordered = [name for name in FIGURES if name in own] + sorted(own - FIGURES.keys())
    try:
        world = World.of(record)
    except InputError:
        world = World()  # the truth is damaged, which is said among the problems
    try:
        turned = scene(record, world)
    except InputError:
        turned = ""  # path or map are damaged
    # What a sentence on top says of a comparison is not said again.
    sections = [
        {
            "title": _TITLES.get(comparison.against, f"Against {comparison.against}"),
            "accuracy": "" if comparison.accuracy in verdict.path.sentence else comparison.accuracy,
            "statistics": comparison.statistics,
            "figures": {} if comparison.against == "itself" else _told(comparison.figures),
            "images": _images(folder, comparison.pictures),
        }
        for comparison in comparisons
    ]
    beside, alone = _beside(record.summary)
    sections.append({"title": "The run", "beside": beside, "figures": alone, "images": _images(folder, ordered)})
    loader = PackageLoader("rbpf.validation.report", "templates")
    environment = Environment(loader=loader, autoescape=select_autoescape(), trim_blocks=True, lstrip_blocks=True)
    environment.filters["digits"], environment.filters["share"] = digits, share
    told = {
        "verdict": verdict,
        "world": world,
        "facts": _facts(record),
        "command": _command(record),
        "remarks": [*record.summary.get("remarks", ()), *problems],
        "on_frames": record.summary.get("problems", ()),
        "sections": [each for each in sections if any(each.get(part) for part in each if part != "title")],
        "video": VIDEO if (folder / VIDEO).is_file() else None,
        "scene": turned,
        "program": program() if turned else "",
    }
    write_text(folder / PAGE, environment.get_template(PAGE).render(title=record.name, **told))
    return verdict


def _facts(record: RunFolder) -> str:
    """System, size, date and version of a run."""
    summary, day = record.summary, str(record.summary.get("finished", ""))[:10]
    counted = [f"{summary[name]} {name}" for name in ("frames", "particles") if name in summary]
    return ", ".join([record.system, *counted, *([day] if day else []), f"rbpf {record.config.get('rbpf', '')}"])


def _command(record: RunFolder) -> str:
    """The command that repeats a run; nothing of a system that is not on the command line."""
    kind = CONFIGS.get(record.system)
    return "" if kind is None else shlex.join(command_of(record.config, asdict(kind())))


def _images(folder: Path, names: list[str]) -> list[Picture]:
    # A link may show what its maker must not see of the disk of whoever opens the run.
    inside = folder.resolve()
    found = []
    for name in names:
        path = folder / name
        if path.is_file() and path.resolve().is_relative_to(inside):
            data = path.read_bytes()
            width, height = struct.unpack(">II", data[16:24]) if len(data) >= 24 else (1, 1)
            bare = path.stem.rpartition("_")[2]
            drawn = FIGURES.get(name) or (None if bare in _CAPTIONS else FIGURES.get(f"{bare}.png"))
            caption = _CAPTIONS.get(bare, "") if drawn is None else (drawn.__doc__ or "").splitlines()[0]
            beside = path.with_suffix(f".{VECTORS}")
            vectors = beside.name if beside.is_file() else ""
            found.append(Picture(path.stem, base64.b64encode(data).decode(), caption, width > _WIDE * height, vectors))
    return found


def _beside(summary: Mapping[str, Any]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Figures that other paths have too, a row each with a head, and all others."""
    columns = ["filter", *dict.fromkeys(_OTHERS.values())]
    rows: dict[str, dict[str, str]] = {}
    taken = set(_ELSEWHERE)
    for name in summary:
        for prefix, column in _OTHERS.items():
            bare = name.removeprefix(prefix)
            if bare != name and bare in summary and bare not in _ELSEWHERE:
                rows.setdefault(bare, {"filter": digits(summary[bare], bare)})[column] = digits(summary[name], bare)
                taken |= {name, bare}
            elif bare != name and bare in _ELSEWHERE:
                taken.add(name)
    used = [column for column in columns if any(column in row for row in rows.values())]
    table = {_label(name): [row.get(column, "") for column in used] for name, row in rows.items()}
    alone = {name: value for name, value in summary.items() if name not in taken}
    return ({"": used} | table if table else {}), _told(alone)


def _told(figures: Mapping[str, Any]) -> dict[str, str]:
    """Names and numbers as a reader wants them, without what has no value."""
    found = {}
    for name, value in figures.items():
        if isinstance(value, Mapping):
            found[_label(name)] = ", ".join(f"{inner} {digits(item, name)}" for inner, item in value.items())
        elif value is not None:
            found[_label(name)] = digits(value, name)
    return found


def _label(name: str) -> str:
    """A name in words, without its unit."""
    bare, _, unit = name.rpartition("_")
    return _WORDS.get(name, (bare if unit in _UNITS and bare else name).replace("_", " "))


def digits(value: Any, name: str = "") -> str:
    """A figure with three digits and more only before the point, and its unit, which is the end of its name."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    unit = _UNITS.get(name.rpartition("_")[2], "")
    if unit == "m" and isinstance(value, float) and 0.0 < abs(value) < 0.1:
        value, unit = 1e3 * value, "mm"
    if isinstance(value, int):
        text = f"{value:,}"
    elif not np.isfinite(value) or (value and not 1e-4 <= abs(value) < 1e9):
        text = f"{value:.2g}"
    else:
        whole = int(np.floor(np.log10(abs(value)))) + 1 if value else 1
        text = f"{value:,.{max(0, 3 - max(whole, 1) if abs(value) >= 1.0 else 3 - whole)}f}"
    return f"{text}{'' if unit == '°' else ' ' if unit else ''}{unit}"


def share(value: float) -> str:
    """A fraction in whole per cent."""
    return f"{100.0 * value:.0f} %"
