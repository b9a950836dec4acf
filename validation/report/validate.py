"""Compares a finished run with the truth, the batch optimum or a reconstruction, and puts the result on its page.

A new comparison is one function from a run to a `Comparison`, entered into `COMPARISONS`.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder
from rbpf.runs.plots import World
from rbpf.runs.reading import RunFolder
from rbpf.runs.truth import TRUTH
from rbpf.validation.consistency.comparison import Comparison, write_comparison
from rbpf.validation.consistency.verdict import Verdict
from rbpf.validation.report.page import write_report

if TYPE_CHECKING:
    from rbpf.validation.gtsam.batch_problem import Optimum

KEY_FRAMES = 60
"""Most of a run that COLMAP reconstructs: matching takes minutes for so many, and grows faster than they do."""
Compare = Callable[[RunFolder], Comparison]
"""With pictures in the run's folder."""


def _groundtruth(record: RunFolder) -> Comparison:
    from rbpf.validation.consistency.against_groundtruth import compare_with_truth, truth_errors
    from rbpf.validation.report.comparison_pictures import draw_truth

    errors = truth_errors(record)
    return replace(compare_with_truth(record, errors), pictures=draw_truth(record, errors))


def compare_gtsam(record: RunFolder, optimum: "Optimum | None" = None) -> Comparison:
    """A run beside the batch posterior, from its optimum where it is known: written into its folder, with pictures.

    Raises:
        InputError: see `compare_with_batch`.
    """
    from rbpf.validation.consistency.against_batch import compare_with_batch
    from rbpf.validation.report.comparison_pictures import plot_against_batch

    comparison, found = compare_with_batch(record, optimum)
    comparison = replace(comparison, pictures=plot_against_batch(found, record.folder, World.of(record)))
    write_comparison(record.folder, comparison)
    return comparison


def _camera_colmap(record: RunFolder) -> Comparison:
    """A run over images beside COLMAP's reconstruction of every n-th."""
    from rbpf.validation.colmap.against_colmap import compare_folder_with_colmap
    from rbpf.validation.colmap.reconstruct import ReconstructionOptions
    from rbpf.validation.report.comparison_pictures import plot_against_colmap

    usual = ReconstructionOptions()
    every = max(usual.every, -(-len(record.path.mean) // KEY_FRAMES))
    found = compare_folder_with_colmap(record.folder, replace(usual, every=every))
    figures = {f"run_{name}": value for name, value in found.run.as_dict().items()}
    if found.truth is not None:
        figures |= {f"truth_{name}": value for name, value in found.truth.as_dict().items()}
    accuracy = f"The path is {1e3 * found.run.path.rmse:.3g} mm (rms) from COLMAP's reconstruction of the same images."
    pictures = plot_against_colmap(found.run, record.estimate, record.folder)
    return Comparison("colmap", accuracy, figures, pictures=pictures)


ANY = "*"
COMPARISONS: dict[str, dict[str, Compare]] = {
    "groundtruth": {ANY: _groundtruth},
    "gtsam": dict.fromkeys(("range-bearing", "mono", "stereo"), compare_gtsam),
    "colmap": {"mono": _camera_colmap, "stereo": _camera_colmap},
}
"""By what a run is compared with, then by the run's system."""


def validate(folder: Path, against: str, out: Path | None = None) -> Verdict:
    """Compares a run, writes `validation_AGAINST.json` and the pictures, and builds the report again; returns the verdict.

    Args:
        folder: of the run.
        against: a name in `COMPARISONS`.
        out: a further folder for the JSON.

    Raises:
        InputError: the comparison is not possible; the report is written all the same, and says why.
    """
    record = RunFolder.open(folder)
    try:
        known = COMPARISONS.get(against)
        if known is None:
            raise InputError(f"a run is compared with {', '.join(COMPARISONS)}, not with {against}")
        compare = known.get(record.system, known.get(ANY))
        if compare is None:
            able = ", ".join(sorted(known)) or "no system yet"
            raise InputError(
                f"a run of the system {record.system!r} cannot be compared with {against} (possible: {able})"
            )
        comparison = compare(record)
    except InputError as error:
        write_report(folder, [f"Not compared with {against}: {error}."])
        raise
    write_comparison(folder, comparison)
    if out is not None:
        prepare_folder(out)
        write_comparison(out, comparison)
    return write_report(folder)


def report_run(folder: Path) -> Verdict:
    """The page of a run that has just finished: compared with the truth where its recording has one."""
    if (folder / TRUTH).is_file():
        return validate(folder, "groundtruth")
    return write_report(folder)
