"""A run over images from recording to report: filter, batch optimum, scores, files, pictures, video."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder
from rbpf.runs.provenance import left_out
from rbpf.sensors.calibration.boards import Board, MarkerBoard, find_board, find_markers
from rbpf.sensors.readers import ImageSequence, KnownPixels, Topics, open_images, read_known_points
from rbpf.sensors.readers.images.sequence import UNNAMED
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.known_map import read_known_map
from rbpf.systems.mono.video import VideoRun, first_image, run_images
from rbpf.validation.consistency.validate import report_run
from rbpf.validation.gtsam.mono_batch import adjust_run, score_batch
from rbpf.validation.image_run import CHECKPOINT, Progress, Telling, write_batch
from rbpf.validation.mono_folder import write_mono_run
from rbpf.validation.report.mono_pictures import plot_mono_run
from rbpf.validation.report.mono_rerun import write_rerun
from rbpf.validation.report.mono_video import write_annotated
from rbpf.validation.report.page import VIDEO


@dataclass(frozen=True)
class Recording:
    """Where a run's input lies.

    Attributes:
        images: a sequence of any kind that `open_images` knows.
        known_points: table of known points; None starts without any.
        calibration: camera.yaml in place of the sequence's own camera.
        board: chessboard that is seen in the first image; its corners are the known points, in its frame.
        markers: board of ArUco markers of which some are seen in the first image; likewise.
        map: run folder, or its map, in which the camera is to be found; the map is not changed. None maps anew.
        topics: of a ROS bag, which images and which truth.

    Raises:
        InputError: two of known points, board, markers and map are given, or two topics of images.
    """

    images: Path
    known_points: Path | None = None
    calibration: Path | None = None
    board: Board | None = None
    map: Path | None = None
    markers: MarkerBoard | None = None
    topics: Topics = UNNAMED

    def __post_init__(self) -> None:
        if len(self.topics.images) > 1:
            raise InputError(
                f"one camera has one topic of images: give one of {' and '.join(self.topics.images)}"
            )
        if self.known_points is not None and self.board is not None:
            raise InputError("a run starts from known points or from a chessboard: give one of the two")
        starts = self.known_points, self.board, self.markers
        if self.markers is not None and any(start is not None for start in starts[:2]):
            raise InputError("a run starts from markers, a chessboard or known points: give one of the three")
        if self.map is not None and any(start is not None for start in starts):
            raise InputError(
                "in a known map a run starts from the map: leave out known points and chessboard"
            )

    def sources(self) -> dict[str, str | float | bool]:
        """For config.yaml."""
        named = {
            "recording": self.images,
            "known_points": self.known_points,
            "calibration": self.calibration,
            "known_map": self.map,
        }
        board: dict[str, str | float] = {}
        if self.board is not None:
            size = f"{self.board.columns}x{self.board.rows}"
            board = {"board": size, "square_m": self.board.square_m}
        if self.markers is not None:
            size = f"{self.markers.columns}x{self.markers.rows}"
            board = {"aruco": size, "marker_m": self.markers.side_m, "gap_m": self.markers.gap_m}
            board["dictionary"] = self.markers.dictionary
        localize = {} if self.map is None else {"localize": True}
        return (
            {name: str(path) for name, path in named.items() if path is not None}
            | board
            | localize
            | self.topics.entries()
        )

    def open(self) -> tuple[ImageSequence, KnownPixels | None]:
        """The images, and the known points if there are any.

        Raises:
            InputError: a file is wrong, or the board is not found in the first image.
        """
        known = None if self.known_points is None else read_known_points(self.known_points)
        sequence = open_images(self.images, self.calibration, self.topics)
        if self.board is not None:
            known = find_board(first_image(sequence), self.board)
        if self.markers is not None:
            known = find_markers(first_image(sequence), self.markers)
        return sequence, known


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
    mapped = None if recording.map is None else read_known_map(recording.map)
    sequence, known = recording.open()
    if out is not None:
        prepare_folder(out)
    total = len(sequence)
    told = None if on_frame is None else lambda t, _frame, _run: on_frame(t + 1, total)
    checkpoint = None if out is None else out / CHECKPOINT
    return run_images(sequence, config, known, told, checkpoint, resume, mapped)


def finish_mono(
    run: VideoRun,
    recording: Recording,
    out: Path,
    video: bool = True,
    rerun: Path | None = None,
    batch: bool = True,
    telling: Telling | None = None,
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
        telling: whom to tell how far it is, and the time that the batch adjustment may take.
    """
    telling = telling or Telling()
    mapped = run.slam.map()
    sources = recording.sources() | left_out(video=video, batch=batch)
    entries = write_mono_run(run, mapped, out, sources)
    adjust = partial(adjust_run, run, telling.batch_s, telling.on_iteration)
    optimum = write_batch(out, entries, adjust if batch else None, partial(score_batch, run))
    plot_mono_run(run, mapped, out, optimum)
    if video:
        write_annotated(run, out / VIDEO, telling.on_frame)
    else:
        (out / VIDEO).unlink(missing_ok=True)
    if rerun is not None:
        write_rerun(run, mapped, rerun)
    verdict = report_run(out)
    return entries | {"verdict": verdict.trust, "sentences": verdict.said}
