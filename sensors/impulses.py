"""Impulse noise, salt and pepper: pixels that were struck by something that is no light, and that SIFT takes for blobs.

A lens spreads a point over neighbouring pixels, so that no camera sees one that differs from all its neighbours. Where
more pixels do than a few specks explain, those that stick out are replaced by the median of their surroundings; all
other pixels, and all other images, stay as they are to the byte. The dots of a pattern projector look like struck
pixels: a rig that has one should run without (`pair.mend`).
"""

from typing import NamedTuple

import numpy as np

LEAP = 40
"""Grey levels between a struck pixel and all its neighbours: several times the noise of any usable image."""

SPECKS = 0.001
"""Share of isolated pixels up to which an image is left as it is."""


class Mended(NamedTuple):
    """An image (H, W) uint8 without impulses, and the fraction of the pixels that were replaced; 0 where none was."""

    image: np.ndarray
    struck: float


def without_impulses(image: np.ndarray) -> Mended:
    """Finds and replaces struck pixels of an image (H, W) uint8."""
    import cv2

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    above = cv2.subtract(image, cv2.dilate(image, ring))
    below = cv2.subtract(cv2.erode(image, ring), image)
    if ((above > LEAP) | (below > LEAP)).mean() <= SPECKS:
        return Mended(image, 0.0)
    # Struck pixels beside one another are no peaks, but at the edge of what is around them.
    median = cv2.medianBlur(image, 3)
    edge = (image >= cv2.dilate(image, ring)) | (image <= cv2.erode(image, ring))
    struck = edge & (cv2.absdiff(image, median) > LEAP)
    return Mended(np.where(struck, median, image), float(struck.mean()))
