"""Impulse noise, salt and pepper: single corrupted pixels, which SIFT takes for blobs.

A lens spreads a point over neighbouring pixels, so that no camera sees one that differs from all its neighbours. Where
more pixels do than a few specks explain, those that stick out are replaced by the median of their surroundings; all
other pixels, and all other images, stay as they are to the byte. The dots of a pattern projector look like
impulses: a rig that has one should run with `pair.filter_impulses=False`.
"""

from typing import NamedTuple

import numpy as np

LEAP = 40
"""Grey levels between a corrupted pixel and all its neighbours: several times the noise of any usable image."""

TOLERATED_FRACTION = 0.001
"""Fraction of isolated pixels up to which an image is left as it is."""


class Filtered(NamedTuple):
    """An image (H, W) uint8 without impulses, and the fraction of the pixels that were replaced; 0 where none was."""

    image: np.ndarray
    replaced_fraction: float


def remove_impulses(image: np.ndarray) -> Filtered:
    """Finds and replaces corrupted pixels of an image (H, W) uint8."""
    import cv2

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    above = cv2.subtract(image, cv2.dilate(image, ring))
    below = cv2.subtract(cv2.erode(image, ring), image)
    if ((above > LEAP) | (below > LEAP)).mean() <= TOLERATED_FRACTION:
        return Filtered(image, 0.0)
    # Corrupted pixels beside one another are no peaks, but at the edge of what is around them.
    median = cv2.medianBlur(image, 3)
    edge = (image >= cv2.dilate(image, ring)) | (image <= cv2.erode(image, ring))
    corrupted = edge & (cv2.absdiff(image, median) > LEAP)
    return Filtered(np.where(corrupted, median, image), float(corrupted.mean()))
