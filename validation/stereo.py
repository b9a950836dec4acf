"""A stereo run from recording to report: filter, batch optimum, scores, files, pictures."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rbpf.runs.files import prepare_folder
from rbpf.runs.provenance import left_out
from rbpf.sensors.readers import ImageSequence, Topics, open_stereo
from rbpf.sensors.readers.images.sequence import UNNAMED
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.run import StereoRun, run_images
from rbpf.validation.finish import Callbacks
from rbpf.validation.gtsam.stereo_batch import adjust_stereo, score_stereo_batch
from rbpf.validation.image_run import CHECKPOINT, Progress, write_batch
from rbpf.validation.report.page import VIDEO
from rbpf.validation.report.stereo_frames import write_annotated_pairs
from rbpf.validation.report.stereo_pictures import plot_stereo_run
from rbpf.validation.report.stereo_rerun import write_stereo_rerun
from rbpf.validation.report.validate import report_run
from rbpf.validation.stereo_folder import write_stereo_run


@dataclass(frozen=True)
class StereoRecording:
    """Where a run's input lies.

    Attributes:
        pairs: a sequence of any kind that `open_stereo` knows.
        calibration: camera.yaml in place of the sequence's own camera.
        topics: of a ROS bag, which images and which truth.
    """

    pairs: Path
    calibration: Path | None = None
    topics: Topics = UNNAMED

    def open(self) -> ImageSequence:
        """The pairs.

        Raises:
            InputError: a file is wrong.
        """
        return open_stereo(self.pairs, self.calibration, topics=self.topics)

    def sources(self) -> dict[str, str]:
        """For config.yaml."""
        named = {"recording": self.pairs, "calibration": self.calibration}
        return {name: str(path) for name, path in named.items() if path is not None} | self.topics.entries()


def start_stereo(
    recording: StereoRecording,
    config: StereoConfig,
    out: Path | None = None,
    resume: bool = False,
    on_frame: Progress | None = None,
) -> StereoRun:
    """Opens a sequence and filters it.

    Args:
        recording: what to filter.
        config: all settings.
        out: folder for checkpoints, created where it does not exist; None keeps none.
        resume: go on from the checkpoint in `out`.
        on_frame: called with the pairs done and their number.

    Raises:
        InputError: the recording or a setting is wrong.
    """
    sequence = recording.open()
    if out is not None:
        prepare_folder(out)
    total = len(sequence)
    told = None if on_frame is None else lambda t, _run: on_frame(t + 1, total)
    return run_images(sequence, config, told, None if out is None else out / CHECKPOINT, resume)


def finish_stereo(
    run: StereoRun,
    recording: StereoRecording,
    out: Path,
    video: bool = True,
    rerun: Path | None = None,
    batch: bool = True,
    callbacks: Callbacks | None = None,
) -> dict[str, Any]:
    """Writes all files, pictures, video and report of a run; returns the entries of summary.json and the verdict.

    The filter's own files are complete before the batch adjustment begins.

    Args:
        run: what was filtered.
        recording: where it came from.
        out: the run's folder.
        video: also write the annotated video.
        rerun: file of a recording for the Rerun viewer; None writes none.
        batch: also adjust the same measurements in batch, and score the optimum.
        callbacks: who is told how far it is, and the time that the batch adjustment may take.
    """
    mapped, callbacks = run.slam.map(), callbacks or Callbacks()
    sources = recording.sources() | left_out(video=video, batch=batch)
    entries = write_stereo_run(run, mapped, out, sources)
    adjust = partial(adjust_stereo, run, callbacks.batch_s, callbacks.on_iteration)
    optimum = write_batch(out, entries, adjust if batch else None, partial(score_stereo_batch, run))
    plot_stereo_run(run, mapped, out, optimum)
    if video:
        write_annotated_pairs(run, recording.open(), out / VIDEO, callbacks.on_frame)
    else:
        (out / VIDEO).unlink(missing_ok=True)
    if rerun is not None:
        write_stereo_rerun(run, recording.open(), mapped, rerun)
    verdict = report_run(out)
    return entries | {"verdict": verdict.trust, "sentences": verdict.said}
