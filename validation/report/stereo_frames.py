"""The annotated frames and video of a stereo run: what each feature of the left image was to the map."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.sensors.readers import ImageSequence
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.systems.stereo.run import PairSeen, StereoRun
from rbpf.validation.report.video import (
    FOUND,
    STARTED,
    Caption,
    Place,
    annotate,
    cross,
    drawn_scale,
    drawn_size,
    write_video,
)

COLOURS = {
    FeatureKind.FEATURE: (150, 150, 150),
    FeatureKind.CANDIDATE: (255, 190, 40),
    FeatureKind.LANDMARK: FOUND,
    FeatureKind.NEW: STARTED,
}
NAMES = {
    FeatureKind.FEATURE: "feature",
    FeatureKind.CANDIDATE: "candidate",
    FeatureKind.LANDMARK: "landmark",
    FeatureKind.NEW: "new",
}
"""In the order in which they are drawn."""


def draw_pair(
    image: np.ndarray | None, seen: PairSeen, caption: Caption, size: tuple[int, int]
) -> np.ndarray:
    """A left image (H, W, 3) uint8 with its features; a line leads from each to where the right camera has it.

    Args:
        image: (height, width) uint8; None where it could not be read.
        seen: its features.
        caption: what is written above.
        size: width and height of the images, px.
    """

    def paint(draw: Any, place: Place) -> None:
        for kind, colour in COLOURS.items():
            for u, v, right in seen.of(kind).tolist():
                draw.line(place(np.array([[u, v], [right, v]])), fill=colour, width=drawn_scale(size[0]))
                cross(draw, place(np.array([u, v]))[0], colour)

    return annotate(image, size, caption, [(NAMES[kind], COLOURS[kind]) for kind in COLOURS], paint)


def annotated_pairs(run: StereoRun, sequence: ImageSequence) -> Iterator[np.ndarray]:
    """The frames (H, W, 3) uint8, as they are needed.

    Args:
        run: what was filtered.
        sequence: its images.
    """
    camera = run.rig.camera
    for t, (frame, seen) in enumerate(zip(sequence.frames(), run.seen, strict=False)):
        held = f"{int(run.observed[t])} landmarks" if run.updated[t] else "no update"
        text = f"pair {t}   {len(seen.kind)} features   {int(run.agreeing[t])} agree   {held}"
        alarm = "" if t == 0 or run.agreeing[t] else "NO MOTION FOUND"
        if frame.image is None or frame.right is None:
            alarm = "NO PAIR"
        yield draw_pair(frame.image, seen, Caption(text, alarm), (camera.width, camera.height))


def write_annotated_pairs(
    run: StereoRun,
    sequence: ImageSequence,
    path: Path,
    on_frame: Callable[[int, int], None] | None = None,
) -> None:
    """Writes an MP4 of all pairs that were filtered; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        sequence: its images.
        path: the file.
        on_frame: called with the frames written and their number.
    """
    camera = run.rig.camera
    size = drawn_size(camera.width, camera.height)
    # A recording without times counts its pairs.
    write_video(annotated_pairs(run, sequence), size, run.per_stamp * run.stamps_ns, path, on_frame)
