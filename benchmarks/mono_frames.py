"""Frames per second of the whole monocular system on rendered images, without decoding."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.rows import Row, Settings
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageFrame, ImageSequence, KnownPixels, open_images, read_known_points
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

SETTLING, TIMED, MEASUREMENTS = 30, 90, 25
WIDTHS = 320, 640
FRACTION_OF_WIDTH = 0.625
"""Focal length relative to the image's width: the desk world's 400 px at 640."""


@dataclass(frozen=True)
class Decoded(Source):
    """Images in memory, as the cost of reading them is not the system's."""

    held: list[ImageFrame]

    def frames(self, start: int) -> Iterator[ImageFrame]:
        return iter(self.held[start:])


def rendered(width: int, frames: int) -> tuple[ImageSequence, KnownPixels]:
    """A desk in 4 : 3 images of this width."""
    height, focal = width * 3 // 4, FRACTION_OF_WIDTH * width
    camera = Pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    with TemporaryDirectory() as folder:
        desk = Path(folder) / "desk"
        simulate_images(TexturedDesk(frames=frames), Imaging(), camera, desk, seed=0)
        sequence = open_images(desk)
        known = read_known_points(desk / "known_points.csv")
        return replace(sequence, source=Decoded(list(sequence.frames()))), known


def run(settings: Settings) -> list[Row]:
    """A row per size, against OpenCV's tracking of as many corners from frame to frame, without map or filter."""
    timed = settings.repetitions(TIMED)
    return [figure(width, timed) for width in WIDTHS]


def figure(width: int, timed: int) -> Row:
    sequence, known = rendered(width, SETTLING + timed)
    done = filter_opened(open_mono(sequence, MonoConfig(particles=50), known))
    stages = {name: float(np.median(part[SETTLING:])) * 1e3 for name, part in by_stage(done).items()}
    peer = optical_flow(sequence)
    whole = done.log["seconds"][SETTLING:]
    hz, mean_hz = 1.0 / float(np.median(whole)), 1.0 / float(whole.mean())
    text = ", ".join(f"{name} {spent:.3g} ms" for name, spent in stages.items())
    return Row(
        f"mono frames {width}x{width * 3 // 4}",
        hz,
        "frames/s",
        "OpenCV's optical flow of 25 corners",
        1.0 / peer,
        peer * hz,
        higher=True,
        notes=(
            f"medians: {text}; {mean_hz:.3g} frames/s on the average, fastest frame {whole.min() * 1e3:.3g} ms; "
            f"{done.log['found'][SETTLING:].mean():.3g} of {done.log['searched'][SETTLING:].mean():.3g} measurements found"
        ),
        tolerance=0.5,
    )


def optical_flow(sequence: ImageSequence) -> float:
    """Median seconds per frame of the pyramidal Lucas-Kanade tracker."""
    images = [frame.image for frame in sequence.frames() if frame.image is not None]
    seconds = []
    for before, now in pairwise(images[SETTLING:]):
        corners = cv2.goodFeaturesToTrack(before, MEASUREMENTS, 0.01, 20.0)
        start = time.perf_counter()
        cv2.calcOpticalFlowPyrLK(before, now, corners, None)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def by_stage(run: Run) -> dict[str, np.ndarray]:
    """Seconds of each frame (T,) by stage."""
    return {
        "search": run.log["seconds_search"],
        "filter and report": run.log["seconds"] - run.log["seconds_search"] - run.log["seconds_new_landmarks"],
        "new_landmarks": run.log["seconds_new_landmarks"],
    }
