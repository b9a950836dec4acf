"""The annotated video of a run: images are decoded again, drawn and encoded one after the other."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from rbpf.systems.mono.video import VideoRun
from rbpf.validation.report.annotated import Caption, drawn_size
from rbpf.validation.report.mono_frames import draw_frame
from rbpf.validation.report.video_file import write_video


def write_annotated(run: VideoRun, path: Path, on_frame: Callable[[int, int], None] | None = None) -> None:
    """Writes an MP4 of all frames that were filtered; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        path: the file.
        on_frame: called with the frames written and their number.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """
    camera = run.sequence.camera
    write_video(annotated_frames(run), drawn_size(camera.width, camera.height), run.stamps_ns, path, on_frame)


def annotated_frames(run: VideoRun) -> Iterator[np.ndarray]:
    """The frames (H, W, 3) uint8, as they are needed."""
    camera = run.sequence.camera
    frames = zip(run.sequence.frames(), run.searches, strict=False)
    for t, (frame, sighting) in enumerate(frames):
        points, rays = int(run.points[t]), int(run.rays[t])
        text = (
            f"frame {t}   found {int(run.found[t])} of {int(run.searched[t])}   "
            f"map {points} points, {rays} rays"
        )
        alarm = "LOST" if run.lost[t] else ""
        if t in run.relocalisations:
            alarm = "FOUND AGAIN"
        if frame.image is None:
            alarm = f"NO IMAGE {alarm}"
        yield draw_frame(frame.image, sighting, Caption(text, alarm), camera.width, camera.height)
