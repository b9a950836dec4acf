"""From a run to its report: files, batch optimum, scores, pictures, video, verdict. It drives no run.

Everything after the files of the run itself is made from its folder, so that it can be made again without the
recording; only the annotated video needs the images once more.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.files import OnDone
from rbpf.runs.folder import write_run, write_summary
from rbpf.runs.plots import draw_run
from rbpf.runs.reading import RunFolder
from rbpf.runs.run import Run
from rbpf.runs.trajectory import write_tum
from rbpf.runs.truth import LEAST, TRUTH
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.consistency.comparison import COMPARISON
from rbpf.validation.metrics.scores import BATCH, is_anonymous, score_landmarks, score_run
from rbpf.validation.report.live import write_rerun
from rbpf.validation.report.page import VIDEO, write_report
from rbpf.validation.report.validate import COMPARISONS, compare_gtsam, validate
from rbpf.validation.report.video import PICTURES, annotated_frames, write_video

#: Observations of a stereo pair that are adjusted at once after a run: more take minutes and gigabytes, and are left to
#: who asks for it.
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
    """Writes everything that a run leaves; returns the entries of summary.json and the verdict.

    The run's own files are complete before the batch adjustment begins. `sources` is what was filtered, for
    config.yaml; `recording` is one of them. `video` and `batch` also make the annotated video, of a run over images,
    and the batch optimum of the same measurements; `rerun` is the file of a recording for the Rerun viewer. `on_frame`
    is called with the frames drawn and their number; `on_iteration` and `most_iterations` are as of `solve_problem`.
    Raises InputError: a file cannot be written.
    """
    wanted = {"video": video, "batch": batch} if run.system.name in PICTURES else {"batch": batch}
    if run.system.name not in COMPARISONS["gtsam"]:  # it measures nothing that a batch optimiser takes
        wanted, batch = {}, False
    # What is not made is an entry of config.yaml, so that a repetition does not make it either.
    entries = write_run(run, out, dict(sources) | {name: False for name, asked in wanted.items() if not asked})
    (out / BATCH).unlink(missing_ok=True)
    for path in out.glob(f"{COMPARISON}*.json"):  # of an earlier run, with their pictures
        for old in (path, *out.glob(f"{path.stem.removeprefix(COMPARISON)}_*.p[nd][gf]")):
            old.unlink()
    if batch:
        try:
            entries |= add_batch(RunFolder.open(out), most_iterations, on_iteration)
        except InputError as error:
            entries["batch_problem"] = str(error)
    entries |= score_run(RunFolder.open(out))
    write_summary(out, entries)
    found = RunFolder.open(out)
    draw_run(found)
    if video and run.system.name in PICTURES:
        write_video(annotated_frames(run), run.log.stamps_ns, out / VIDEO, on_frame)
    else:
        (out / VIDEO).unlink(missing_ok=True)
    if rerun is not None:
        write_rerun(run, rerun)
    verdict = validate(out, "groundtruth") if (out / TRUTH).is_file() else write_report(out)
    said = [*entries.get("remarks", ()), *verdict.said]
    return entries | {"path_grade": verdict.path.grade, "verdict": verdict.trust, "sentences": said}


def add_batch(found: RunFolder, most: int | None, on_iteration: Callable[[int, float], None] | None) -> dict[str, Any]:
    """Solves for a run's batch optimum, writes batch.tum and the comparison with it; returns entries of summary.json.

    An InputError says that there are too many observations, or what `solve_problem` says.
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
    except InputError as error:  # too short, or its camera stays where it began
        return entries | {"batch_problem": str(error)}
    shown = ("filter_minus_batch_rmse_m", "log_evidence_batch", "log_evidence_batch_error", "posterior_draws_ess")
    return entries | {name: figures[name] for name in shown if name in figures}
