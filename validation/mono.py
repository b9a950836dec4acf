"""A run over images from recording to report: filter, scores, files, pictures, video."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rbpf.sensors.readers.images import KnownPixels, open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import VideoRun, run_images
from rbpf.validation.files import prepare_folder
from rbpf.validation.mono_folder import write_mono_run
from rbpf.validation.mono_map import summarise_mono_map
from rbpf.validation.mono_pictures import plot_mono_run
from rbpf.validation.mono_rerun import write_rerun
from rbpf.validation.mono_video import write_annotated
from rbpf.validation.report import VIDEO
from rbpf.validation.validate import report_run

CHECKPOINT = "checkpoint.npz"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Recording:
    """Where a run's input lies.

    Attributes:
        images: a sequence of any kind that `open_images` knows.
        known_points: table of known points; None starts without any.
        calibration: camera.yaml in place of the sequence's own camera.
    """

    images: Path
    known_points: Path | None = None
    calibration: Path | None = None

    def sources(self) -> dict[str, str]:
        """For config.yaml."""
        named = {
            "recording": self.images,
            "known_points": self.known_points,
            "calibration": self.calibration,
        }
        return {name: str(path) for name, path in named.items() if path is not None}

    def read_known(self) -> KnownPixels | None:
        """The known points, if there are any."""
        return None if self.known_points is None else read_known_points(self.known_points)


def start_mono(
    recording: Recording,
    config: MonoConfig,
    out: Path | None = None,
    resume: bool = False,
    on_frame: Progress | None = None,
) -> VideoRun:
    """Opens a sequence and filters it.

    Args:
        recording: what to filter.
        config: all settings.
        out: folder for checkpoints, created where it does not exist; None keeps none.
        resume: go on from the checkpoint in `out`.
        on_frame: called with the frames done and their number.

    Raises:
        InputError: the recording or a setting is wrong.
    """
    known = recording.read_known()
    sequence = open_images(recording.images, recording.calibration)
    if out is not None:
        prepare_folder(out)
    total = len(sequence)
    told = None if on_frame is None else lambda t, _frame, _run: on_frame(t + 1, total)
    return run_images(sequence, config, known, told, None if out is None else out / CHECKPOINT, resume)


def finish_mono(
    run: VideoRun,
    recording: Recording,
    out: Path,
    video: bool = True,
    rerun: Path | None = None,
    on_frame: Progress | None = None,
) -> dict[str, Any]:
    """Writes all files, pictures, the annotated video and the report of a run; returns the entries of summary.json.

    Args:
        run: what was filtered.
        recording: where it came from.
        out: the run's folder.
        video: also write the annotated video.
        rerun: file of a recording for the Rerun viewer; None writes none.
        on_frame: called with the frames drawn and their number.
    """
    mapped = summarise_mono_map(run.filter)
    entries = write_mono_run(run, mapped, out, recording.sources())
    plot_mono_run(run, mapped, out)
    if video:
        write_annotated(run, out / VIDEO, on_frame)
    else:
        (out / VIDEO).unlink(missing_ok=True)
    if rerun is not None:
        write_rerun(run, mapped, rerun)
    verdict = report_run(out)
    return entries | {"verdict": verdict.trust}
