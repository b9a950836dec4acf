"""How active search fares on a sequence, real or simulated: hit rate, correlations, survival of features."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.sensors.readers.images import ImageFrame, open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import VideoRun, run_images

SMOOTH_FRACTION = 0.05
"""The noise is read off this fraction of an image's blocks, the smoothest."""
BLOCK_PX = 16
DARKEST, BRIGHTEST = 20.0, 235.0
"""Blocks outside are clipped: they show no noise."""
MOST_IMAGES = 25
"""From which an image's own figures are taken."""


@dataclass(frozen=True)
class SearchStatistics:
    """Of one run; S searches of single features in single frames, F features.

    Attributes:
        name: of the sequence.
        frames: that were filtered.
        lost: frames in which the camera was lost.
        score: (S,) best normalised cross-correlation in the ellipse; −1 where nothing could be compared.
        found: (S,) whether it was taken: alike enough, and in agreement with the others.
        accept: least score of a match.
        attempts: (F,) frames in which each feature was looked for.
        dropped: (F,) whether it was dropped in the end because it failed too often.
        noise: grey levels, standard deviation in the smoothest parts of the images.
        contrast: grey levels, median standard deviation of blocks of `BLOCK_PX`.
    """

    name: str
    frames: int
    lost: int
    score: np.ndarray
    found: np.ndarray
    accept: float
    attempts: np.ndarray
    dropped: np.ndarray
    noise: float
    contrast: float

    @property
    def share_found(self) -> float:
        """Share of the searches that ended with a match."""
        return float(self.found.mean())

    @property
    def share_unlike(self) -> float:
        """Share in which nothing was alike enough."""
        return float((self.score < self.accept).mean())

    @property
    def share_astray(self) -> float:
        """Share in which something was alike, in a place that does not agree with the others."""
        return float(((self.score >= self.accept) & ~self.found).mean())

    def survival(self, most: int) -> np.ndarray:
        """(most + 1,) fraction of features that are not dropped within so many frames of being looked for.

        E. Kaplan and P. Meier's estimate (1958): a feature that left the view, or lived at the end, is counted as long
        as it was looked for.
        """
        return survival(self.attempts, self.dropped, most)


def survival(lengths: np.ndarray, ended: np.ndarray, most: int) -> np.ndarray:
    """Kaplan–Meier estimate (most + 1,) of the fraction that lasts beyond 0, 1, … `most`.

    Args:
        lengths: (F,) whole numbers, how long each was watched.
        ended: (F,) whether it ended then; else it went out of sight.
        most: last length of the estimate.
    """
    times = np.arange(most + 1)
    at_risk = (lengths[:, None] >= times).sum(axis=0)
    ends = ((lengths[:, None] == times) & ended[:, None]).sum(axis=0)
    return np.asarray(np.cumprod(1.0 - ends / np.maximum(at_risk, 1)))


def measure_search(folder: Path, config: MonoConfig, name: str | None = None) -> SearchStatistics:
    """Filters a sequence, from its known points where it has any, and counts.

    Args:
        folder: of the sequence.
        config: of the run.
        name: of the sequence, by default its folder's.

    Raises:
        InputError: the sequence cannot be filtered.
    """
    points = folder / "known_points.csv"
    known = read_known_points(points) if points.exists() else None
    sequence = open_images(folder)
    every = max(1, len(sequence) // MOST_IMAGES)
    score, found, looks = [], [], []

    def note(t: int, frame: ImageFrame, run: VideoRun) -> None:
        searched = run.sensor.searched
        score.append(searched.score)
        found.append(searched.found.copy())
        if t % every == 0 and frame.image is not None:
            looks.append(_look(frame.image))

    run = run_images(sequence, config, known, note)
    table = run.sensor.table
    noise, contrast = np.median(looks, axis=0).tolist()
    return SearchStatistics(
        name or folder.name,
        run.stamps_ns.size,
        int(run.lost.sum()),
        np.concatenate(score),
        np.concatenate(found),
        config.search.min_correlation,
        table.attempts.copy(),
        ~table.alive,
        noise,
        contrast,
    )


def _look(image: np.ndarray) -> tuple[float, float]:
    """Noise, and contrast of blocks, in grey levels.

    The noise is what a kernel leaves that cancels planes (J. Immerkær 1996), where there is least of it.
    """
    grey = image.astype(float)
    inner = grey[:-2] - 2.0 * grey[1:-1] + grey[2:]
    rough = _blocks((inner[:, :-2] - 2.0 * inner[:, 1:-1] + inner[:, 2:]) / 6.0).std(axis=1)
    blocks = _blocks(grey[1:-1, 1:-1])
    level = blocks.mean(axis=1)
    light = (level > DARKEST) & (level < BRIGHTEST)
    smooth = rough[light] if light.any() else rough
    return float(np.quantile(smooth, SMOOTH_FRACTION)), float(np.median(blocks.std(axis=1)))


def _blocks(grey: np.ndarray) -> np.ndarray:
    """(B, BLOCK_PX²) values."""
    rows, columns = (size // BLOCK_PX for size in grey.shape)
    cut = grey[: rows * BLOCK_PX, : columns * BLOCK_PX]
    parts = cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).swapaxes(1, 2)
    return np.asarray(parts.reshape(rows * columns, -1))
