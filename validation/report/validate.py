"""Compares a finished run with the truth, the batch optimum or a reconstruction, and puts the result on its page.

A new comparison is one function from a run to a `Comparison`, entered into `COMPARISONS`; one that needs a file besides
takes its path, too, and is entered into `WITH_A_FILE`.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder
from rbpf.runs.folder import write_summary
from rbpf.runs.plots import World
from rbpf.runs.reading import RunFolder
from rbpf.runs.trajectory import associate, read_tum
from rbpf.runs.truth import EXACT, Precision
from rbpf.validation.consistency import comparison as verdicts
from rbpf.validation.consistency.comparison import Comparison, Verdict
from rbpf.validation.metrics.accuracy import ate, rpe
from rbpf.validation.report.page import write_report

if TYPE_CHECKING:
    from rbpf.validation.gtsam.batch_problem import Optimum

#: Most of a run that COLMAP reconstructs: matching takes minutes for so many, and grows faster than they do.
KEY_FRAMES = 60
Compare = Callable[[RunFolder], Comparison]  #: With pictures in the run's folder.
TRUTH = "groundtruth"


def compare_gtsam(record: RunFolder, optimum: "Optimum | None" = None) -> Comparison:
    """A run beside the batch posterior, see `compare_with_batch`: written into its folder, with pictures."""
    from rbpf.validation.consistency.against_batch import compare_with_batch
    from rbpf.validation.report.comparison_pictures import plot_against_batch

    comparison, found = compare_with_batch(record, optimum)
    comparison = replace(comparison, pictures=plot_against_batch(found, record.folder, World.of(record)))
    verdicts.write_comparison(record.folder, comparison)
    return comparison


def _camera_colmap(record: RunFolder) -> Comparison:
    """A run over images beside COLMAP's reconstruction of every n-th."""
    from rbpf.validation.colmap.compare import ReconstructionOptions, compare_folder_with_colmap
    from rbpf.validation.report.comparison_pictures import plot_against_colmap

    every = max(ReconstructionOptions().every, -(-len(record.path.world_from_body) // KEY_FRAMES))
    run, truth = compare_folder_with_colmap(record.folder, ReconstructionOptions(every=every))
    figures = {f"run_{name}": value for name, value in run.as_dict().items()}
    if truth is not None:
        figures |= {f"truth_{name}": value for name, value in truth.as_dict().items()}
    accuracy = f"The path is {verdicts.distance(run.path.rmse)} (rms) from COLMAP's reconstruction of the same images."
    pictures = plot_against_colmap(run, record.estimate, record.folder)
    return Comparison("colmap", accuracy, figures, pictures=pictures)


def _relations(record: RunFolder, file: Path) -> Comparison:
    """A run's paths by the relations of a file; the figures go into its summary.json, too."""
    from rbpf.validation.metrics import relations as relative

    known = relative.read_relations(file)
    paths = {prefix: record.folder / name for prefix, name in relative.PATHS.items()}
    scores = {p: relative.relation_errors(read_tum(path), known) for p, path in paths.items() if path.is_file()}
    figures = {prefix + name: value for prefix, one in scores.items() for name, value in relative.entries(one).items()}
    write_summary(record.folder, dict(record.summary) | figures)
    said = relative.sentence(scores.get("final_", scores[""]), len(known[0]))
    return Comparison("relations", said, figures)


def _path(record: RunFolder, file: Path) -> Comparison:
    """A run beside another path of the same recording, rigidly aligned."""
    estimate, reference = associate(record.trajectory, read_tum(file))
    apart, moved = ate(estimate, reference, "rigid"), rpe(estimate, reference)
    figures = {
        "path_minus_other_rmse_m": apart.rmse,
        "path_minus_other_max_m": apart.max,
        "rpe_translation_rmse_m": moved.translation_rmse,
        "rpe_rotation_rmse_deg": moved.rotation_rmse_deg,
        "steps_compared": len(reference),
    }
    said = f"The path is {apart.rmse:.3g} m (rms, after a rigid alignment) from that of {file.name}."
    return Comparison("path", said, figures)


#: By what a run is compared with, besides the truth, then by the run's system.
COMPARISONS: dict[str, dict[str, Compare]] = {
    "gtsam": dict.fromkeys(("range-bearing", "mono", "stereo"), compare_gtsam),
    "colmap": {"mono": _camera_colmap, "stereo": _camera_colmap},
}
#: By what a file holds that a run of any system is compared with.
WITH_A_FILE: dict[str, Callable[[RunFolder, Path], Comparison]] = {"relations": _relations, "path": _path}


def validate(
    folder: Path, against: str, out: Path | None = None, file: Path | None = None, truth: Precision = EXACT
) -> Verdict:
    """Compares a run, writes `validation_AGAINST.json` and the pictures, and builds the report again; returns the verdict.

    `against` is `TRUTH` or a name in `COMPARISONS`, or with a file one in `WITH_A_FILE`; `out` is a further folder for the
    JSON; `truth` is how precise the ground truth is, by default exact. An InputError says that it is not possible; the
    report is written all the same, and says why.
    """
    record = RunFolder.open(folder)
    try:
        if file is not None:
            comparison = WITH_A_FILE[against](record, file)
        elif against == TRUTH:
            from rbpf.validation.consistency.against_groundtruth import compare_with_truth, truth_errors
            from rbpf.validation.report.comparison_pictures import draw_truth

            errors = truth_errors(record, truth)
            comparison = replace(compare_with_truth(record, errors), pictures=draw_truth(record, errors))
        elif against not in COMPARISONS:
            raise InputError(f"a run is compared with {', '.join([TRUTH, *COMPARISONS])}, not with {against}")
        elif record.system not in COMPARISONS[against]:
            able = f"(possible: {', '.join(sorted(COMPARISONS[against]))})"
            raise InputError(f"a run of the system {record.system!r} cannot be compared with {against} {able}")
        else:
            comparison = COMPARISONS[against][record.system](record)
    except InputError as error:
        write_report(folder, [f"Not compared with {against}: {error}."])
        raise
    verdicts.write_comparison(folder, comparison)
    if out is not None:
        prepare_folder(out)
        verdicts.write_comparison(out, comparison)
    return write_report(folder)
