"""Realism of the simulated laboratory's images: numbers, matches and noise of SIFT features, compared with recordings.

In addition to the table, it plots a plan of the laboratory with the robot's path, and a few of its views.
"""

import csv
from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import tyro

from examples.studies.lab import LabDrive, TexturedLab, furnished
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_stereo
from rbpf.validation.simulation.images import Imaging, Shutter
from rbpf.validation.simulation.render import Renderer

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BASELINE_M = 0.12
RATIO = 0.8
"""Threshold of the ratio test (D. Lowe 2004)."""

ROWS_PX, EPIPOLAR_PX = 3.0, 1.5
"""Largest row difference between the two cameras, and largest epipolar distance between two times."""


@dataclass(frozen=True)
class Moment:
    """Left and right image, the next left one, and the disparities [px] in the left one, if known."""

    left: np.ndarray
    right: np.ndarray
    following: np.ndarray
    disparity: np.ndarray | None = None


def rendered(seed: int, noise_std: Sequence[float], width: int, moments: int) -> dict[str, list[Moment]]:
    """The laboratory at times spread over the tour, as `examples.studies.lab --noise-std` renders it, by its noise."""
    camera = Pinhole(width, 3 * width // 4, 0.78125 * width, 0.78125 * width, 0.5 * width - 0.5, 0.375 * width - 0.5)
    rng = np.random.default_rng(seed)
    scene = TexturedLab(texel_m=1.92 / width).build(rng)
    renderer, taken = Renderer(scene.rectangles, camera), dict[str, list[Moment]]()
    for std in noise_std:
        shutter = Shutter(scene, Imaging(noise_std=std, known=0), camera, renderer, deepcopy(rng))
        pictures = taken[f"lab, noise {std:g}"] = list[Moment]()
        for frame in np.linspace(0, 3990, moments).astype(int).tolist():
            left, right = shutter.images(frame, BASELINE_M)
            depth, _ = renderer.depth(scene.world_from_camera[frame])
            pictures.append(Moment(left, right, shutter.images(frame + 1)[0], camera.fx * BASELINE_M / depth))
    return taken


def recorded(folder: Path, moments: int) -> Iterator[Moment]:
    """A recording at times spread over it."""
    sequence = open_stereo(folder)
    wanted = set(np.linspace(0, len(sequence) - 2, min(moments, len(sequence) - 1)).astype(int).tolist())
    for k, (frame, following) in enumerate(pairwise(sequence.frames())):
        if k in wanted and frame.right is not None:
            yield Moment(frame.image, frame.right, following.image)


class Sift:
    """Features of images and their matches."""

    def __init__(self) -> None:
        self._sift, self._matcher = cv2.SIFT.create(nfeatures=0), cv2.BFMatcher()

    def features(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (K, 2) and descriptors (K, 128)."""
        found, descriptors = self._sift.detectAndCompute(image, None)
        return np.array([point.pt for point in found]), descriptors

    def matches(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of matching descriptors in both."""
        pairs = [pair for pair in self._matcher.knnMatch(a, b, k=2) if len(pair) == 2]
        kept = [best for best, second in pairs if best.distance < RATIO * second.distance]
        return np.array([m.queryIdx for m in kept], int), np.array([m.trainIdx for m in kept], int)


def robust_std(values: np.ndarray) -> float:
    """Standard deviation of a normal distribution with the same median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if values.size else np.nan


def smooth_part(px: np.ndarray, disparity: np.ndarray, rows: np.ndarray, width: int) -> np.ndarray:
    """Row offsets (K,) due to small calibration errors: a fit over the image, without outliers."""
    u, v = (px / width - 0.5).T
    d = disparity / width
    design = np.stack([np.ones_like(u), u, v, d, u * v, v * d], axis=-1)
    keep = np.ones(len(rows), bool)
    for _ in range(8):
        factors, *_ = np.linalg.lstsq(design[keep], rows[keep], rcond=None)
        rest = rows - design @ factors
        keep = np.abs(rest) < 3.0 * robust_std(rest)
    return np.asarray(design @ factors)


def statistics(moments: Iterable[Moment]) -> dict[str, float]:
    """Means over all moments; the differences of rows and disparities pooled."""
    sift, counts = Sift(), []
    rows, rest, disparity = [], [], []
    for moment in moments:
        (px, keys), (px_right, keys_right), (px_next, keys_next) = map(
            sift.features, (moment.left, moment.right, moment.following)
        )
        here, there = sift.matches(keys, keys_right)
        apart = px[here] - px_right[there]
        width = moment.left.shape[1]
        pair = (np.abs(apart[:, 1]) < ROWS_PX) & (apart[:, 0] > 0.0) & (apart[:, 0] < 0.15 * width)
        here, apart = here[pair], apart[pair]
        now, then = sift.matches(keys, keys_next)
        _, agree = cv2.findFundamentalMat(px[now], px_next[then], cv2.FM_RANSAC, EPIPOLAR_PX, 0.99)
        again = 0 if agree is None else int(agree.sum())
        counts.append([len(px), len(here), len(here) / len(px), again / len(px), moment.left.std()])
        rows.append(apart[:, 1])
        rest.append(apart[:, 1] - smooth_part(px[here], apart[:, 0], apart[:, 1], width))
        if moment.disparity is not None:
            column, row = np.round(px[here]).astype(int).T
            disparity.append(apart[:, 0] - moment.disparity[row, column])
    mean, least = np.mean(counts, axis=0), np.min(counts, axis=0)
    return {
        "features": float(mean[0]),
        "stereo matches": float(mean[1]),
        "fewest stereo matches": float(least[1]),
        "share matched, left to right": float(mean[2]),
        "share matched, frame to frame": float(mean[3]),
        "rows, px": robust_std(np.concatenate(rows)),
        "rows without the calibration's part, px": robust_std(np.concatenate(rest)),
        "disparity against the truth, px": robust_std(np.concatenate(disparity)) if disparity else np.nan,
        "contrast, grey levels": float(mean[4]),
    }


def draw_plan(file: Path, seed: int) -> None:
    """Plots the laboratory from above, and both drives."""
    figure, axes = plt.subplots(figsize=(9.0, 5.6), layout="constrained")
    for low, high in furnished(np.random.default_rng(seed)).blocks:
        grey = 0.3 + 0.5 * min(low[2] / 2.0, 1.0)
        axes.add_patch(plt.Rectangle(low[:2], *(high - low)[:2], facecolor=str(grey), edgecolor="none", alpha=0.7))
    for trajectory in ("tour", "turn_back"):
        theta, x, y = LabDrive(trajectory).travelled().world_from_robot.T
        axes.plot(x, y, linewidth=1.2, label=trajectory)
        axes.quiver(x[::50], y[::50], np.cos(theta[::50]), np.sin(theta[::50]), scale=60.0, width=0.002)
    axes.set(xlim=(-0.2, 18.2), ylim=(-0.2, 10.2), aspect="equal", xlabel="x, m", ylabel="y, m")
    axes.add_patch(plt.Rectangle((0.0, 0.0), 18.0, 10.0, fill=False))
    axes.legend(loc="upper right")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main(
    beside: tuple[Path, ...] = (),
    noise_std: tuple[float, ...] = (2.0, 8.0),
    moments: int = 16,
    seed: int = 0,
    out: Path = Path("demo/lab_images"),
    quick: bool = False,
) -> dict[str, dict[str, float]]:
    """Prints the table.

    Args:
        beside: recordings of a stereo camera to compare with.
        noise_std: of the simulated sensor, grey levels, one row each.
        moments: number of image pairs, spread over each sequence.
        seed: of the laboratory.
        out: folder for the table and the pictures.
        quick: few small images.
    """
    width, moments = (320, 2) if quick else (640, moments)
    taken = rendered(seed, noise_std, width, moments)
    table = {name: statistics(pictures) for name, pictures in taken.items()}
    table |= {folder.name: statistics(recorded(folder, moments)) for folder in beside}
    out.mkdir(parents=True, exist_ok=True)
    names = list(next(iter(table.values())))
    with open(out / "lab_images.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["", *table], *([name, *(t[name] for t in table.values())] for name in names)])
    print(f"{'':>42}" + "".join(f"{title:>18}" for title in table))
    for name in names:
        print(f"{name:>42}" + "".join(f"{entries[name]:18.3g}" for entries in table.values()))
    draw_plan(out / "plan.png", seed)
    last = next(reversed(taken.values()))
    views = [moment.left for moment in last[:: max(moments // 6, 1)][: 3 if quick else 6]]
    cv2.imwrite(str(out / "views.png"), np.vstack([np.hstack(views[k : k + 3]) for k in range(0, len(views), 3)]))
    return table


if __name__ == "__main__":
    tyro.cli(main)
