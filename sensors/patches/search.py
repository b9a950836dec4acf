"""Image patches of landmarks: cut at the first observation, warped to the predicted view, matched by correlation (E06 §4.1).

Pixels are (column, row), with the centre of the top-left one at (0, 0). Images are grey, (H, W) uint8.
"""

from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.features.interface import checked_image

#: Weight of one product of a grey level and a template, in pairs of `rbpf.kernels.signature`: a quarter of their real cost,
#: so that threads start only for a millisecond of work or more. On a busy machine a frame would wait for them longer.
PAIRS_PER_PRODUCT, PAIRS_PER_TEMPLATE = 1.0 / 1600.0, 75.0
LARGEST_SIZE = 101  #: Largest side of a template: sums of squares over a window fit 32 bits.


@final
@dataclass(frozen=True)
class PatchMatches:
    """Matches of templates, one row each."""

    px: np.ndarray  #: (K, 2) subpixel position; NaN if not searched.
    score: np.ndarray  #: (K,) normalised cross-correlation there, −1 if not searched.
    second: np.ndarray  #: (K,) score of the second-best peak in the ellipse, at least 3 px away; −1 if there is none.
    #: (K, 2, 2) covariance of the position, from the residual and the image gradients [px²]; NaN if the score still rises
    #: beyond the ellipse, so that the position is a whole pixel, or if noise alone explains the gradients.
    cov: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """(K,) second over best score, from 0 (unambiguous) to 1 (ambiguous, or not matched)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.maximum(self.second, 0.0) / self.score
        return np.where(self.score > 0.0, ratio, 1.0)


def cut(image: np.ndarray, px: np.ndarray, half: int = 15) -> np.ndarray | None:
    """A window (2 half + 1, 2 half + 1) uint8 around a pixel (2,), None if it reaches beyond the image.

    Exact at a whole pixel, else by cubic interpolation (Catmull-Rom). Raises InputError: the image is not (H, W) uint8.
    """
    from rbpf.sensors.patches.kernels import cut_window

    image = checked_image(image)
    x, y = float(px[0]), float(px[1])
    if not (half <= x <= image.shape[1] - 1 - half and half <= y <= image.shape[0] - 1 - half):
        return None
    window = np.empty((2 * half + 1, 2 * half + 1), np.uint8)
    cut_window(image, x, y, window)
    return window


def warp(sources: np.ndarray, affines: np.ndarray, size: int = 11) -> np.ndarray:
    """Templates (K, size, size) float32: windows warped to another view.

    Where the new view is smaller, each pixel averages all source pixels that it covers. NaN if the template reaches beyond
    the source, or the affine map is not finite.

    Args:
        sources: (K, S, S) uint8, from `cut`.
        affines: (K, 2, 2), source offset [px] by offset in the new view [px]: 2 I for a view of half the size.
        size: odd.

    Raises InputError: a shape or type is wrong, or a size is even.
    """
    from rbpf.sensors.patches.kernels import warp_all

    sources, affines = np.ascontiguousarray(sources), np.ascontiguousarray(affines, float)
    square = sources.ndim == 3 and sources.shape[1] == sources.shape[2] and sources.shape[1] % 2 == 1
    if not square or sources.dtype != np.uint8:
        raise InputError(f"sources must be (K, S, S) uint8 with S odd, got {sources.shape} {sources.dtype}")
    count = sources.shape[0]
    if affines.shape != (count, 2, 2):
        raise InputError(f"affines must be ({count}, 2, 2), one for each source, got {affines.shape}")
    if not _fits(size):
        raise InputError(f"the size of a template must be odd, from 3 to {LARGEST_SIZE}, got {size}")
    templates = np.empty((count, size, size), np.float32)
    warp_all(sources, affines, templates)
    return templates


def search(
    image: np.ndarray,
    templates: np.ndarray,
    centres: np.ndarray,
    covs: np.ndarray,
    sigmas: float = 3.0,
    most_px: float = 40.0,
    least_std: float = 3.0,
) -> PatchMatches:
    """Searches each template in its predicted ellipse, by zero-mean normalised cross-correlation.

    All whole pixels of the ellipse are tried at which the template fits into the image; half a pixel's diagonal is added to
    the half axes in quadrature, so that there is at least one. The best is refined to subpixel precision.

    Args:
        image: (H, W) uint8.
        templates: (K, size, size) float32 from `warp`, size odd.
        centres: (K, 2) predicted pixels.
        covs: (K, 2, 2) their covariances [px²].
        sigmas: the ellipse's half axes in standard deviations.
        most_px: largest distance from the centre in columns and rows; infinite to search a whole image.
        least_std: a template whose grey levels have a smaller standard deviation is not searched.

    Returns:
        The matches. A template, centre or covariance that is not valid is not searched.

    Raises InputError: a shape or type is wrong.
    """
    from rbpf.kernels.signature import run_driver
    from rbpf.sensors.patches.kernels import search_all

    image = checked_image(image)
    templates = np.ascontiguousarray(templates, np.float32)
    centres, covs = np.ascontiguousarray(centres, float), np.ascontiguousarray(covs, float)
    limits, count = (float(sigmas), float(most_px), float(least_std)), templates.shape[0]
    if templates.ndim != 3 or templates.shape[1] != templates.shape[2] or not _fits(templates.shape[1]):
        expected = f"(K, size, size) with an odd size from 3 to {LARGEST_SIZE}"
        raise InputError(f"templates must be {expected}, got {templates.shape}")
    if centres.shape != (count, 2) or covs.shape != (count, 2, 2):
        expected = f"centres ({count}, 2) and covs ({count}, 2, 2), one for each template"
        raise InputError(f"a search needs {expected}, got {centres.shape} and {covs.shape}")
    if not (0.0 < limits[0] < np.inf and limits[1] >= 0.0):
        raise InputError(f"sigmas must be positive and most_px not negative, got {limits[0]!r} and {limits[1]!r}")
    found = np.full((count, 7), np.nan)
    found[:, 2:4] = -1.0
    # The cost, in the unit of `rbpf.kernels.signature`.
    reach = np.minimum(limits[0] * np.sqrt(np.fmax(covs.diagonal(axis1=1, axis2=2), 0.0)), limits[1])
    sides = np.minimum(2.0 * reach + 1.0, image.shape[::-1])
    products = float(sides.prod(axis=1).sum()) * templates.shape[1] ** 2
    pairs = int(products * PAIRS_PER_PRODUCT + count * PAIRS_PER_TEMPLATE)
    run_driver(search_all, pairs, count, image, templates, centres, covs, *limits, found)
    return PatchMatches(found[:, :2], found[:, 2], found[:, 3], found[:, [4, 5, 5, 6]].reshape(count, 2, 2))


def _fits(size: int) -> bool:
    """Whether this is a valid template size."""
    return 3 <= size <= LARGEST_SIZE and size % 2 == 1
