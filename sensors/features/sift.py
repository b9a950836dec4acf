"""Keypoints of the difference of Gaussians with SIFT descriptors (D. Lowe, IJCV 60(2), 2004), the features of S05 §III-A.

OpenCV detects and describes. Pixels are (column, row), with the centre of the top-left one at (0, 0).

A descriptor has 128 entries: 4 × 4 spatial windows of 8 orientations each; or 36, as S05 has it: 3 × 3 windows of 4
orientations. S05 does not say how its descriptors were formed. Here windows are added two by two in both directions,
overlapping, so that 4 become 3; and with h_o the histogram's entry at o · 45°, the entry at o · 90° becomes
h_2o + (h_2o−1 + h_2o+1) / 2, so that every one of the 8 counts once and none is preferred to its mirror image.

Entries are then scaled to length 1 ("sift"), or to sum 1 and their roots taken ("root"), which makes the product of
two descriptors the Bhattacharyya coefficient of two histograms (R. Arandjelović, A. Zisserman, CVPR 2012). Either way
|a − b|² = 2 − 2 aᵀb.
"""

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.patches.search import checked_image

LENGTHS = (36, 128)

_SIGMA = 1.6
"""Blur of the first image of an octave; OpenCV's default, which is Lowe's."""


@dataclass(frozen=True)
class SiftConfig:
    """Settings of the detector and of the descriptors.

    Attributes:
        features: the most keypoints of an image, those of highest contrast; 0 for all.
        working_scale: the image is reduced by this before it is looked at, 0.5 for half of each side; places and
            scales stay in pixels of the image that was given.
        contrast: least contrast of an extremum; OpenCV's unit, Lowe's 0.03 is 0.09 with three layers.
        edge: largest ratio of principal curvatures.
        layers: scales per octave.
        length: of a descriptor, 36 or 128.
        norm: "root" or "sift", see the module.

    Raises:
        InputError: a number is out of its range.
    """

    features: int = 1000
    working_scale: float = 0.5
    contrast: float = 0.04
    edge: float = 10.0
    layers: int = 3
    length: Literal[36, 128] = 36
    norm: Literal["root", "sift"] = "root"

    def __post_init__(self) -> None:
        if self.features < 0:
            raise InputError(f"features must be a number of keypoints, or 0 for all, got {self.features}")
        if not 0.0 < self.working_scale <= 1.0:
            raise InputError(f"working_scale must be above 0 and at most 1, got {self.working_scale}")
        if not (self.contrast >= 0.0 and self.edge > 1.0 and self.layers >= 1):
            expected = "contrast of at least 0, edge above 1 and at least one layer"
            raise InputError(f"expected {expected}, got {self.contrast}, {self.edge} and {self.layers}")
        if self.length not in LENGTHS:
            raise InputError(f"a descriptor has 36 or 128 entries, got length {self.length}")
        if self.norm not in ("root", "sift"):
            raise InputError(f'norm must be "root" or "sift", got {self.norm!r}')


@final
@dataclass(frozen=True)
class Keypoints:
    """Keypoints of an image, of highest contrast first.

    Attributes:
        px: (K, 2) place.
        scale: (K,) standard deviation of the Gaussian at which each was found, px.
        orientation: (K,) direction of the strongest slope, [0, 2π), from the columns' axis towards the rows'.
        contrast: (K,) of the extremum.
        descriptors: (K, d) float32 of length 1.
    """

    px: np.ndarray
    scale: np.ndarray
    orientation: np.ndarray
    contrast: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return self.px.shape[0]

    def take(self, rows: np.ndarray) -> "Keypoints":
        """Some of them, by number or by mask."""
        return Keypoints(
            self.px[rows],
            self.scale[rows],
            self.orientation[rows],
            self.contrast[rows],
            self.descriptors[rows],
        )


@final
class Sift:
    """Finds and describes keypoints.

    Args:
        config: settings.
    """

    def __init__(self, config: SiftConfig | None = None) -> None:
        self.config = config or SiftConfig()
        self._detector: Any = None

    def detect(self, image: np.ndarray) -> Keypoints:
        """Keypoints of an image (H, W) uint8; none where there is no texture.

        A place with two strong directions is two keypoints.

        Raises:
            InputError: the image is not (H, W) uint8.
        """
        image = _reduced(checked_image(image), self.config.working_scale)
        found, histograms = self._opencv().detectAndCompute(image, None)
        if not found:
            return self._none()
        table = np.array([(*p.pt, p.size, p.angle, p.response) for p in found])
        ratio = self.config.working_scale
        points = Keypoints(
            px=(table[:, :2] + 0.5) / ratio - 0.5,
            scale=0.5 * table[:, 2] / ratio,
            orientation=np.deg2rad(table[:, 3]) % (2.0 * np.pi),
            contrast=table[:, 4],
            descriptors=descriptors_from_histograms(histograms, self.config.length, self.config.norm),
        )
        # OpenCV keeps the strongest, and ties, in no particular order.
        order = np.lexsort((points.orientation, points.px[:, 0], points.px[:, 1], -points.contrast))
        return points.take(order[: self.config.features or None])

    def _opencv(self) -> Any:
        if self._detector is None:
            import cv2

            config = self.config
            # Without the precise scaling every place is a quarter of a pixel off.
            self._detector = cv2.SIFT.create(
                config.features, config.layers, config.contrast, config.edge, _SIGMA, True
            )
        return self._detector

    def _none(self) -> Keypoints:
        none = np.zeros(0)
        return Keypoints(
            np.zeros((0, 2)), none, none, none, np.zeros((0, self.config.length), dtype=np.float32)
        )


def descriptors_from_histograms(histograms: np.ndarray, length: int, norm: str = "root") -> np.ndarray:
    """Descriptors (K, length) float32 of length 1, of SIFT histograms (K, 128) ordered by row, column and orientation."""
    descriptors = histograms.astype(np.float32)
    if length == 36:
        descriptors = pooled(descriptors)
    if norm == "root":
        descriptors = np.sqrt(descriptors)
    return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), np.float32(1e-9))


def pooled(histograms: np.ndarray) -> np.ndarray:
    """Histograms (K, 36) of 3 × 3 × 4 from (K, 128) of 4 × 4 × 8, as the module describes."""
    cells = histograms.reshape(-1, 4, 4, 8)
    beside = 0.5 * (np.roll(cells, 1, axis=3) + np.roll(cells, -1, axis=3))
    turns = (cells + beside)[..., ::2]
    lines = turns[:, :-1] + turns[:, 1:]
    return (lines[:, :, :-1] + lines[:, :, 1:]).reshape(-1, 36)


def _reduced(image: np.ndarray, ratio: float) -> np.ndarray:
    if ratio == 1.0:
        return image
    import cv2

    return cv2.resize(image, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_AREA)


SIZE_PX = 4.0
"""OpenCV's size of a keypoint whose histograms cover a window of 31 × 31 px."""
PAD_PX = 6
"""Windows are set apart by copies of their borders: SIFT blurs the image before it looks."""
LENGTH = 128


def describe(
    image: np.ndarray, px: np.ndarray, scales: np.ndarray | float = 1.0, turns: np.ndarray | float = 0.0
) -> np.ndarray:
    """Descriptors (K, 128) of places (K, 2) in an image.

    Args:
        image: (H, W) uint8.
        px: (K, 2).
        scales: (K,) or one: size of the window that is described, 1 for 31 × 31 px.
        turns: (K,) or one: angle from the image's columns to those of the window, radians, clockwise as it is seen.

    Raises:
        InputError: the image is not (H, W) uint8.
    """
    import cv2

    count = px.shape[0]
    if not count:
        return np.zeros((0, LENGTH), dtype=np.float32)
    sizes = np.broadcast_to(SIZE_PX * np.asarray(scales, float), count)
    degrees = np.broadcast_to(np.rad2deg(turns) % 360.0, count)
    places = [
        cv2.KeyPoint(float(x), float(y), float(size), float(angle))
        for (x, y), size, angle in zip(px, sizes, degrees, strict=True)
    ]
    _, histograms = cv2.SIFT.create().compute(checked_image(image), places)
    total = np.maximum(histograms.sum(axis=1, keepdims=True), 1e-9)
    return np.sqrt(histograms / total)


def describe_windows(windows: np.ndarray, scales: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Descriptors (K, 128) of the centres of windows (K, S, S) uint8, each at its own scale (K,) and turn (K,)."""
    count, size = windows.shape[:2]
    columns = max(1, int(np.ceil(np.sqrt(count))))
    lines, side = -(-count // columns), size + 2 * PAD_PX
    tiles = np.zeros((lines * columns, side, side), dtype=np.uint8)
    tiles[:count] = np.pad(windows, ((0, 0), (PAD_PX, PAD_PX), (PAD_PX, PAD_PX)), mode="edge")
    sheet = tiles.reshape(lines, columns, side, side).swapaxes(1, 2).reshape(lines * side, columns * side)
    line, column = np.divmod(np.arange(count), columns)
    centres = np.stack([column, line], axis=-1) * side + 0.5 * (side - 1)
    return describe(sheet, centres, scales, turns)
