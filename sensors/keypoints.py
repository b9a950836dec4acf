"""Descriptors of places in an image, to find them again without knowing where to look.

SIFT (D. Lowe 2004) at places, sizes and directions that are given, on the image as it is: what moves between the views
(scale, roll) is known or tried, so nothing is detected. Descriptors are compared as R. Arandjelović and A. Zisserman
(2012) do: the product of two is the Bhattacharyya coefficient of their histograms, 1 for equal ones.
"""

import numpy as np

from rbpf.sensors.patches import checked_image

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
