"""From a run to its report: files, batch optimum, scores, pictures, video, verdict; and the comparisons of a run.

Everything after the files of the run itself is computed from its folder, so that it can be repeated without the recording;
only the annotated video needs the images again.

A new comparison is a function from a run to a `Comparison`, entered into `COMPARISONS`; one that also needs a file
takes its path, and is entered into `WITH_A_FILE`.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbpf.errors import InputError
from rbpf.runs.files import BATCH, VIDEO, OnDone, prepare_folder
from rbpf.runs.folder import write_run, write_summary
from rbpf.runs.plots import World, draw_run
from rbpf.runs.reading import RunFolder
from rbpf.runs.run import Run
from rbpf.runs.trajectory import associate, read_tum, write_tum
from rbpf.runs.truth import EXACT, LEAST, TRUTH, Precision
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.consistency import comparison as verdicts
from rbpf.validation.consistency.comparison import Comparison, Verdict
from rbpf.validation.metrics.accuracy import ate, rpe
from rbpf.validation.metrics.scores import is_anonymous, score_landmarks, score_run
from rbpf.validation.report.live import write_rerun
from rbpf.validation.report.page import write_report
from rbpf.validation.report.video import PICTURES, annotated_frames, write_video

if TYPE_CHECKING:
    from rbpf.validation.gtsam.batch_problem import Optimum

#: Maximum number of a stereo run's observations adjusted after the run: more take minutes and gigabytes, and are adjusted
#: only on request.
MOST = 300_000


def finish_run(
    run: Run,
    out: Path,
    sources: Mapping[str, str | float | bool],
    video: bool = True,
    rerun: Path | None = None,
    batch: bool = True,
    on_frame: OnDone | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
    most_iterations: int | None = None,
) -> dict[str, Any]:
    """Writes all results of a run; returns the entries of summary.json and the verdict.

    The run's own files are complete before the batch adjustment begins. `sources` is what was filtered, for
    config.yaml; `recording` is one of them. `video` and `batch` also make the annotated video, of a run over images,
    and the batch optimum of the same measurements; `rerun` is the file of a recording for the Rerun viewer. `on_frame`
    is called with the frames drawn and their number; `on_iteration` and `most_iterations` are as of `solve_problem`.
    Raises InputError: a file cannot be written.
    """
    wanted = {"video": video, "batch": batch} if run.system.name in PICTURES else {"batch": batch}
    if run.system.name not in COMPARISONS["gtsam"]:  # no measurements for a batch optimiser
        wanted, batch = {}, False
    # Omitted results are an entry of config.yaml, so that a repetition omits them, too.
    entries = write_run(run, out, dict(sources) | {name: False for name, asked in wanted.items() if not asked})
    if batch:
        try:
            entries |= add_batch(RunFolder.open(out), most_iterations, on_iteration)
        except InputError as error:
            entries["batch_problem"] = str(error)
    entries |= score_run(RunFolder.open(out))
    write_summary(out, entries)
    draw_run(RunFolder.open(out))
    if video and run.system.name in PICTURES:
        write_video(annotated_frames(run), run.log.stamps_ns, out / VIDEO, on_frame)
    if rerun is not None:
        write_rerun(run, rerun)
    verdict = validate(out, "groundtruth") if (out / TRUTH).is_file() else write_report(out)
    why = entries.get("batch_problem")
    uncompared = [] if why is None else [f"It is not compared with a batch optimum: {why}"]
    said = [*entries.get("remarks", ()), *verdict.said, *uncompared]
    return entries | {"path_grade": verdict.path.grade, "verdict": verdict.trust, "sentences": said}


def add_batch(found: RunFolder, most: int | None, on_iteration: Callable[[int, float], None] | None) -> dict[str, Any]:
    """Computes a run's batch optimum, writes batch.tum and the comparison with it; returns entries of summary.json.

    Raises InputError: too many observations, or as of `solve_problem`.
    """
    from rbpf.validation.consistency.against_batch import solve_run

    measured = found.measurements
    if isinstance(measured, FeatureLog) and isinstance(measured.camera, RectifiedStereo):
        count = sum(frame.landmarks.size for frame in measured.frames)
        if count > MOST:
            raise InputError(
                f"the run has {count} observations, more than the {MOST} that are adjusted in batch with it: "
                "compare it afterwards by rbpf validate RUN --against gtsam"
            )
    optimum = solve_run(found, most, on_iteration)
    write_tum(found.folder / BATCH, optimum.estimate.trajectory)
    entries: dict[str, Any] = {"batch_error": float(optimum.error)}
    if isinstance(optimum.problem, FeatureLog):
        entries["batch_frames"] = int(optimum.steps.size)
        entries["batch_observations"] = int(sum(frame.landmarks.size for frame in optimum.problem.frames))
    elif (found.folder / TRUTH).is_file() and found.truth.rows.size >= LEAST:
        scores = score_landmarks(optimum.estimate, found.truth, is_anonymous(found))
        entries |= {f"batch_{name}": v for name, v in scores.items()}
    try:
        figures = compare_gtsam(found, optimum).figures
    except InputError as error:  # too short, or its camera does not move
        return entries | {"batch_problem": str(error)}
    shown = ("filter_minus_batch_rmse_m", "log_evidence_batch", "log_evidence_batch_error", "posterior_draws_ess")
    return entries | {name: figures[name] for name in shown if name in figures}


#: Maximum frames for COLMAP: matching takes minutes for this many, and grows faster than linearly.
KEY_FRAMES = 60
Compare = Callable[[RunFolder], Comparison]  #: Also draws plots into the run's folder.


def compare_gtsam(record: RunFolder, optimum: "Optimum | None" = None) -> Comparison:
    """Compares a run with the batch posterior, see `compare_with_batch`; written into its folder, with plots."""
    from rbpf.validation.consistency.against_batch import compare_with_batch
    from rbpf.validation.report.comparison_pictures import plot_against_batch

    comparison, found = compare_with_batch(record, optimum)
    comparison = replace(comparison, pictures=plot_against_batch(found, record.folder, World.of(record)))
    verdicts.write_comparison(record.folder, comparison)
    return comparison


def _camera_colmap(record: RunFolder) -> Comparison:
    """Compares a run over images with COLMAP's reconstruction of every n-th."""
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
    """Evaluates a run's paths by the relations of a file; the figures go into its summary.json, too."""
    from rbpf.validation.metrics import relations as relative

    known = relative.read_relations(file)
    paths = {prefix: record.folder / name for prefix, name in relative.PATHS.items()}
    scores = {p: relative.relation_errors(read_tum(path), known) for p, path in paths.items() if path.is_file()}
    figures = {prefix + name: value for prefix, one in scores.items() for name, value in relative.entries(one).items()}
    write_summary(record.folder, dict(record.summary) | figures)
    return Comparison("relations", relative.sentence(scores.get("final_", scores[""]), len(known[0])), figures)


def _path(record: RunFolder, file: Path) -> Comparison:
    """Compares a run with another path of the same recording, rigidly aligned."""
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


#: Comparisons by reference, other than the truth, then by the run's system.
COMPARISONS: dict[str, dict[str, Compare]] = {
    "gtsam": dict.fromkeys(("range-bearing", "mono", "stereo"), compare_gtsam),
    "colmap": {"mono": _camera_colmap, "stereo": _camera_colmap},
}
#: Comparisons of any system's run with a file, by its content.
WITH_A_FILE: dict[str, Callable[[RunFolder, Path], Comparison]] = {"relations": _relations, "path": _path}


def validate(
    folder: Path, against: str, out: Path | None = None, file: Path | None = None, truth: Precision = EXACT
) -> Verdict:
    """Compares a run, writes `validation_AGAINST.json` and the pictures, and builds the report again; returns the verdict.

    `against` is "groundtruth" or a name in `COMPARISONS`, or with a file one in `WITH_A_FILE`; `out` is a further folder for
    the JSON; `truth` is the precision of the ground truth, by default exact. Raises InputError: the comparison is not
    possible; the report is written nevertheless, with the reason.
    """
    record = RunFolder.open(folder)
    try:
        if file is not None:
            comparison = WITH_A_FILE[against](record, file)
        elif against == "groundtruth":
            from rbpf.validation.consistency.against_groundtruth import compare_with_truth, truth_errors
            from rbpf.validation.report.comparison_pictures import draw_truth

            errors = truth_errors(record, truth)
            comparison = replace(compare_with_truth(record, errors), pictures=draw_truth(record, errors))
        elif against not in COMPARISONS:
            raise InputError(f"a run is compared with {', '.join(['groundtruth', *COMPARISONS])}, not with {against}")
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
