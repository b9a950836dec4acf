"""Active search of image patches and corner selection on one thread, against OpenCV's functions."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numba
import numpy as np

from benchmarks.rows import Row, Settings, Timing, interleaved
from rbpf.sensors.features import CornerDetector
from rbpf.sensors.patches.search import cut, search, warp

K, SIZE, RADIUS_PX, SIGMAS = 25, 11, 10.0, 3.0
CORNERS, SPACING_PX = 40, 20.0
COV = (RADIUS_PX / SIGMAS) ** 2 * np.eye(2)


def picture(height: int, width: int, blur_px: float, seed: int = 0) -> np.ndarray:
    """Smoothed noise over the full range of grey levels."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), blur_px), None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)


class Ellipses:
    """Templates from known positions, searched around a prediction: in an ellipse, or in its bounding square."""

    def __init__(self) -> None:
        self.image = picture(480, 640, 1.5)
        rng = np.random.default_rng(1)
        self.truth = rng.integers(40, 440, (K, 2))
        self.sources = np.stack([cut(self.image, place) for place in self.truth])
        self.affines = np.tile(np.eye(2), (K, 1, 1))
        self.templates = warp(self.sources, self.affines)
        self.guess = self.truth + rng.uniform(-4.0, 4.0, (K, 2))
        self.covs = np.tile(COV, (K, 1, 1))

    def ours(self) -> np.ndarray:
        """Positions."""
        return search(self.image, self.templates, self.guess, self.covs, SIGMAS).px

    def peer(self) -> np.ndarray:
        """Whole pixels."""
        reach = int(RADIUS_PX) + SIZE // 2
        corner = np.rint(self.guess).astype(int) - reach
        found = []
        for template, (u, v) in zip(self.templates.astype(np.uint8), corner, strict=True):
            part = self.image[v : v + 2 * reach + 1, u : u + 2 * reach + 1]
            scores = cv2.matchTemplate(part, template, cv2.TM_CCOEFF_NORMED)
            found.append(cv2.minMaxLoc(scores)[3] + np.array([u, v]) + SIZE // 2)
        return np.array(found)

    def warp(self) -> np.ndarray:
        """The warped templates."""
        return warp(self.sources, self.affines)


class WholeImage:
    """One template in a whole small image, as after tracking loss."""

    def __init__(self) -> None:
        self.image = picture(240, 320, 1.5)
        self.truth = np.array([[200.0, 61.0]])
        self.template = warp(cut(self.image, self.truth[0])[None], np.eye(2)[None])

    def ours(self) -> np.ndarray:
        """Position."""
        middle = (np.array([self.image.shape[::-1]]) - 1) / 2
        return search(self.image, self.template, middle, 1e8 * np.eye(2)[None], most_px=np.inf).px

    def peer(self) -> np.ndarray:
        """Whole pixel."""
        scores = cv2.matchTemplate(self.image, self.template[0].astype(np.uint8), cv2.TM_CCOEFF_NORMED)
        return np.array([cv2.minMaxLoc(scores)[3]]) + SIZE // 2


@contextmanager
def one_thread() -> Iterator[None]:
    """Numba and OpenCV on one thread."""
    before = numba.get_num_threads(), cv2.getNumThreads()
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def run(settings: Settings) -> list[Row]:
    """Three rows; the first two after checking that both contestants find the templates."""
    ellipses, whole, scene = Ellipses(), WholeImage(), picture(480, 640, 4.5)
    detector = CornerDetector()
    with one_thread():
        for task in (ellipses, whole):
            if max(np.abs(found() - task.truth).max() for found in (task.ours, task.peer)) > 0.1:
                raise RuntimeError(f"{type(task).__name__}: a template was not found where it had been cut")
        turns = settings.repetitions(300)
        searched = measure({"rbpf": ellipses.ours, "peer": ellipses.peer, "warp": ellipses.warp}, turns)
        everywhere = measure({"rbpf": whole.ours, "peer": whole.peer}, turns // 3)
        chosen = measure(
            {
                "rbpf": lambda: detector.detect(scene, CORNERS, None, SPACING_PX),
                "peer": lambda: cv2.goodFeaturesToTrack(scene, CORNERS, 0.01, SPACING_PX, blockSize=9),
            },
            turns // 3,
        )
    match = "cv2.matchTemplate in the squares"
    warped = f"warping the templates takes {searched['warp'].median * 1e3:.3g} ms more"
    name = f"patch search, {K} ellipses of {RADIUS_PX:g} px"
    return [
        row(name, match, searched, f"places to a fraction of a pixel; {warped}"),
        row("patch search, 320x240", "cv2.matchTemplate", everywhere, "one template"),
        row(f"{CORNERS} corners of 640x480", "cv2.goodFeaturesToTrack", chosen, "smoothed noise"),
    ]


def measure(contestants: dict[str, Callable[[], Any]], turns: int) -> dict[str, Timing]:
    """Times the contestants in turn."""
    return interleaved(contestants, turns, warm_up=5)


def row(name: str, peer: str, times: dict[str, Timing], notes: str) -> Row:
    """A row of milliseconds, with the peer as baseline."""
    ours, theirs = times["rbpf"].median * 1e3, times["peer"].median * 1e3
    return Row(name, ours, "ms", peer, theirs, theirs / ours, notes=f"one thread; {notes}; {times['rbpf'].spread}")
