"""Features of a rectified stereo pair (S05 §III-B), matched along the rows of both images; the left camera is the reference.

Impulse noise (salt and pepper) is removed first (`remove_impulses`): SIFT would detect single corrupted pixels as blobs.

Candidate matches of a left keypoint lie on its row in the right image, at a disparity between zero and that of the nearest
depth, with a similar scale and orientation. The candidate with the nearest descriptor is taken
(`rbpf.sensors.descriptors`), and its column is refined on grey values (`refine`): a window around the left keypoint is
moved along the row of the right image to the least squared difference, with free brightness and contrast (Gauss-Newton; B.
Lucas, T. Kanade 1981, in one dimension).

The noise of z = (u_left, v, u_right): the point on the object at which a keypoint is detected varies between views, with
standard deviation σ_p per axis. The refinement matches the left keypoint's window, so that u_right shares the error of
u_left and adds that of the disparity, σ_d. Both grow with the keypoint's scale,

    cov = [[σ_p², 0, σ_p²], [0, σ_p², 0], [σ_p², 0, σ_p² + σ_d²]],    Mathematics (stereo-noise).

Without the refinement both keypoints have independent errors, and cov = σ_p² I.

A re-observed point can be aligned with its first view (`aligned`): the window around its first pixel, scaled by the growth
of its disparity and rotated as the keypoints, is searched around the keypoint (`rbpf.sensors.patches`). All views then
observe the same point, and σ_p² becomes the alignment's 2 × 2 covariance, from its residual.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, final

import numpy as np

from rbpf import gaussian
from rbpf.arrays import RowByRow
from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.ranges import Formerly, NotNegative, Positive, Range, Ranged, Ratio
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.descriptors import DescriptorMatches, MatchLimits, band_pairs, match_all, match_pairs
from rbpf.sensors.features import Sift
from rbpf.sensors.features.interface import FeatureExtractor, Features, checked_image
from rbpf.sensors.patches.search import search, warp

LEAP = 40  #: Grey levels between a corrupted pixel and all its neighbours: several times the noise of any usable image.
PATCH_HALF_PX, TEMPLATE_PX = 15, 15  #: Half-width of a first view without its middle pixel; and side of its template.
KEYPOINT_PX = 1.0  #: Standard deviation of a keypoint from its first view, for the search; mostly it is 0.3 to 0.7.
LEAST_TURN_RAD = 0.1  #: Smaller image rotations are not corrected: the median of the orientations is no more accurate.
TOLERATED_FRACTION = 0.001  #: Fraction of isolated pixels up to which an image is left unchanged.


def remove_impulses(image: np.ndarray) -> tuple[np.ndarray, float]:
    """An image (H, W) uint8 without corrupted pixels, and the fraction of the pixels that were replaced.

    The optics spread a point over neighbouring pixels, so that no real pixel differs strongly from all its neighbours. If
    more pixels do than a few specks explain, they are replaced by the median of their neighbourhood; all other pixels are
    unchanged. The dots of a pattern projector look like impulses: a rig that has one should run with
    `pair.filter_impulses=False`.
    """
    import cv2

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    above = cv2.subtract(image, cv2.dilate(image, ring))
    below = cv2.subtract(cv2.erode(image, ring), image)
    if ((above > LEAP) | (below > LEAP)).mean() <= TOLERATED_FRACTION:
        return image, 0.0
    # Adjacent corrupted pixels are not single peaks, but lie outside the range of their surroundings.
    median = cv2.medianBlur(image, 3)
    edge = (image >= cv2.dilate(image, ring)) | (image <= cv2.erode(image, ring))
    corrupted = edge & (cv2.absdiff(image, median) > LEAP)
    return np.where(corrupted, median, image), float(corrupted.mean())


@final
@dataclass(frozen=True)
class StereoFeatures(RowByRow):
    """Features of a stereo pair, highest contrast first: the local landmarks {P^L, C^L, α, s, f} of S05 §III-B."""

    z: np.ndarray  #: (K, 3) pixels (u_left, v, u_right).
    cov: np.ndarray  #: (K, 3, 3) of their noise, px².
    points: np.ndarray  #: (K, 3) P^L in the left camera's frame, m.
    cov_points: np.ndarray  #: (K, 3, 3) C^L, m²: `cov` through the Jacobian of the triangulation.
    scale: np.ndarray  #: (K,) of the keypoint, px.
    orientation: np.ndarray  #: (K,) of the keypoint, radians.
    descriptors: np.ndarray  #: (K, 36) or (K, 128) float32 of length 1.
    #: (K, S, S) uint8, each point's first view: the left image around the pixel of its first observation; S = 0 without
    #: alignment to first views.
    patch: np.ndarray
    #: (K, 4) position in that, from its middle, and the disparity, px; orientation, radians. The disparity is 0 for a point
    #: without a first view, too close to the border.
    first: np.ndarray

    @classmethod
    def measured(
        cls,
        rig: RectifiedStereo,
        z: Array,
        cov: Array,
        scale: Array,
        orientation: Array,
        descriptors: np.ndarray,
        patch: np.ndarray | None = None,
        first: np.ndarray | None = None,
    ) -> "StereoFeatures":
        """Triangulates features and their covariances from the pixels; by default without first views."""
        points = rig.triangulate(z)
        jac = np.linalg.inv(rig.jacobian(points))  # Mathematics (stereo-slope)
        cov_points = gaussian.symmetrise(jac @ cov @ np.swapaxes(jac, -1, -2))
        patch = np.zeros((len(z), 0, 0), np.uint8) if patch is None else patch
        first = np.zeros((len(z), 4)) if first is None else first
        return cls(z, cov, points, cov_points, scale, orientation, descriptors, patch, first)

    def at(self, rig: RectifiedStereo, z: Array, cov: Array) -> "StereoFeatures":
        """The same features at other pixels (K, 3), with covariances (K, 3, 3)."""
        return self.measured(rig, z, cov, self.scale, self.orientation, self.descriptors, self.patch, self.first)


SWAPPED, FEWER = 20, 4  #: Swapped images: least matches of negative disparity, and ratio to the positive ones.
#: The calibration is doubted at such a number and fraction of negative disparities; on KITTI it is below 0.01.
IMPOSSIBLE, FRACTION = 5, 0.03
REMEMBERED = 0.9  #: Decay per pair of the counts of matches: about ten pairs have weight.


@dataclass(frozen=True)
class PairConfig(Ranged):
    """How the two images are matched, and how exact the result is. Raises InputError: a number is out of its range."""

    row_px: NotNegative = 1.0  #: rows of a match differ by at most this …
    row_per_scale: NotNegative = 0.25  #: … and this fraction of the keypoint's scale.
    nearest_m: Positive = 0.3  #: least depth; larger disparities are rejected.
    least_disparity_px: Positive = 1.0  #: least disparity; a smaller one does not determine the depth.
    scale_ratio: Ratio = 1.5  #: largest ratio of the two scales.
    turn_rad: Annotated[float, Range(gt=0.0, le=7.0)] = 0.35  #: largest difference of the two orientations.
    limits: MatchLimits = field(default_factory=MatchLimits)  #: of the descriptors.
    #: whether impulse noise (salt and pepper) is removed before keypoints are detected.
    filter_impulses: Annotated[bool, Formerly("mend")] = True
    refine: bool = True  #: whether the disparity is refined on grey values.
    half_px: Annotated[int, Range(ge=1, le=100)] = 5  #: of the refinement's window.
    #: least correlation of the refined windows, else the match is dropped.
    least_correlation: Annotated[float, Range(ge=-1.0, le=1.0)] = 0.8
    shift_px: Positive = 2.0  #: largest change of the column by the refinement.
    align: bool = True  #: whether re-observed points are aligned with their first view; needs `refine`.
    aligned_px: Positive = 0.05  #: σ_p of first views, and of an alignment …
    aligned_residual: Positive = 2.0  #: … to which this multiple of the residual's share is added in quadrature.
    place_px: Positive = 0.25  #: σ_p of a keypoint of scale 0 …
    place_per_scale: NotNegative = 0.02  #: … and what is added to it in quadrature, as a fraction of the scale.
    disparity_px: Positive = 0.1  #: σ_d of a keypoint of scale 0 …
    disparity_per_scale: NotNegative = 0.025  #: … and what is added to it in quadrature.

    def noise(self, scale: np.ndarray, place: np.ndarray | None = None) -> np.ndarray:
        """Covariances (K, 3, 3) of (u_left, v, u_right) for keypoints of scales (K,), px².

        `place` (K, 2, 2) is the covariance of the left pixels, by default that of a keypoint of this scale.
        """
        if place is None:
            place = (self.place_px**2 + (self.place_per_scale * scale) ** 2)[:, None, None] * np.eye(2)
        if not self.refine:
            return place[:, :1, :1] * np.eye(3)
        cov = np.concatenate([place, place[:, :1]], axis=1)
        cov = np.concatenate([cov, cov[:, :, :1]], axis=2)
        cov[:, 2, 2] += self.disparity_px**2 + (self.disparity_per_scale * scale) ** 2
        return cov


def calibration_doubt(wrong: float, matches: float) -> str:
    """A warning if too many matches have a negative disparity for this calibration to be right; else empty."""
    if wrong < IMPOSSIBLE or wrong <= FRACTION * matches:
        return ""
    fraction = f"{100.0 * wrong / matches:.0f} % of the matches"
    return f"{fraction} have a negative disparity, which no point in space has: check the calibration"


@final
class StereoMatcher:
    """Detects, matches and measures the features of stereo pairs.

    Args:
        rig: the two cameras.
        extractor: of the features of one image; SIFT by default.
        config: settings of the matching.

    Raises InputError: the settings contradict one another.
    """

    def __init__(
        self, rig: RectifiedStereo, extractor: FeatureExtractor | None = None, config: PairConfig | None = None
    ) -> None:
        self.rig = rig
        self.extractor = extractor or Sift()
        self.config = config or PairConfig()
        self.impulse_fraction = 0.0  #: Fraction of the pixels that were replaced in the last pair.
        self.rows_px = 0.0  #: Row offset of the right image of the last pair; 0 if rectified.
        #: Known offset of the right image's columns, subtracted from the measurements.
        self.offset_px = 0.0
        self._last: tuple[tuple[np.ndarray, np.ndarray], Features, Features, int] | None = None

    def measure(self, left: np.ndarray, right: np.ndarray) -> StereoFeatures:
        """Features of a pair of images (H, W) uint8; none without texture.

        Raises InputError: the images are not of the camera's size, or they are swapped.
        """
        self.check(left, right)
        self.impulse_fraction = 0.0
        if self.config.filter_impulses:
            (left, one), (right, other) = remove_impulses(left), remove_impulses(right)
            self.impulse_fraction = 0.5 * (one + other)
        images, keypoints = (left, right), (self.extractor.extract(left), self.extractor.extract(right))
        found = self.match(images, *keypoints)
        self._last = images, *keypoints, len(found)
        return found

    @property
    def images(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Left and right of the last pair, without impulse noise; None before the first."""
        return None if self._last is None else self._last[0]

    @property
    def impossible(self) -> tuple[int, int]:
        """Counts of the last pair: matches of negative disparity that pass all other tests, and all matches.

        No point has a negative disparity: such matches indicate cameras rotated or shifted relative to the calibration.
        """
        if self._last is None:
            return 0, 0
        images, left, right, count = self._last
        matches = self._along_rows(right, left)
        px = left.px[matches.second]
        good, u = self._refined(images, px, right.px[matches.first, 0])
        wrong = int((px[good, 0] - u[good] <= -self.config.least_disparity_px).sum())
        return wrong, wrong + count

    @property
    def remark(self) -> str:
        """A remark on defects of the last pair; empty if there were none."""
        found = list[str]()
        if self.impulse_fraction:
            fraction = f"{100.0 * self.impulse_fraction:.1f} %"
            found += [f"{fraction} of the pixels have impulse noise and are replaced by the median around them"]
        if self.rows_px:
            where = f"{abs(self.rows_px):.1f} rows {'lower' if self.rows_px > 0.0 else 'higher'} in the right image"
            found += [f"the pair is not rectified: points are {where}; rectify the images by the cameras' calibration"]
        return "; ".join(found)

    def match(self, images: tuple[np.ndarray, np.ndarray], left: Features, right: Features) -> StereoFeatures:
        """Matches the given keypoints of a pair of images. Raises InputError: the images are swapped."""
        matches = self._along_rows(left, right)
        self.rows_px = 0.0
        # A pair that matches far better when swapped is refused; one that matches on other rows is reported.
        if FEWER * len(matches) < min(len(left), len(right)):
            swapped = len(self._along_rows(right, left))
            if swapped >= SWAPPED and swapped > FEWER * len(matches):
                raise InputError(
                    f"left and right image seem to be swapped: {swapped} matches have a negative disparity and "
                    f"{len(matches)} a positive one; exchange the two cameras, unless one of them delivers a frozen image"
                )
            anywhere = match_all(left.descriptors, right.descriptors, self.config.limits)
            if len(anywhere) >= SWAPPED:
                lower = right.px[anywhere.second, 1] - left.px[anywhere.first, 1]
                typical = float(np.median(lower))
                agree = np.abs(lower - typical) < max(0.5 * abs(typical), self.config.row_px)
                self.rows_px = typical if abs(typical) > self.config.row_px and agree.mean() > 0.5 else 0.0
        z = np.column_stack([left.px[matches.first], right.px[matches.second, 0]])
        good, z[:, 2] = self._refined(images, z[:, :2], z[:, 2])
        matches, z = matches.take(good), z[good] - [0.0, 0.0, self.offset_px]
        far = z[:, 0] - z[:, 2] >= self.config.least_disparity_px
        z, chosen = z[far], left.take(matches.first[far])
        kept, cov = (chosen.scale, chosen.orientation, chosen.descriptors), self.config.noise(chosen.scale)
        if not (self.config.align and self.config.refine):
            return StereoFeatures.measured(self.rig, z, cov, *kept)
        patch, first = first_views(images[0], z, chosen.orientation)
        exact = self.config.noise(chosen.scale, np.tile(self.config.aligned_px**2 * np.eye(2), (len(z), 1, 1)))
        cov = np.where(first[:, 2, None, None] > 0.0, exact, cov)
        return StereoFeatures.measured(self.rig, z, cov, *kept, patch, first)

    def _refined(self, images: tuple[np.ndarray, np.ndarray], px: Array, u: Array) -> tuple[np.ndarray, np.ndarray]:
        """Whether the refinement of columns u (K,) for left pixels px (K, 2) succeeded (K,), and the refined columns."""
        config = self.config
        if not (config.refine and u.size):
            return np.ones(u.size, dtype=bool), u
        found, correlation = refine(*images, px, u, config.half_px)
        return (np.abs(found - u) <= config.shift_px) & (correlation >= config.least_correlation), found

    def _along_rows(self, left: Features, right: Features) -> DescriptorMatches:
        """Matches along rows, each pixel position used once, even if it has keypoints of several orientations."""
        config = self.config
        reach = config.row_px + config.row_per_scale * left.scale
        k, m = band_pairs(left.px[:, 1], right.px[:, 1], reach)
        disparity = left.px[k, 0] - right.px[m, 0]
        most = self.rig.camera.fx * self.rig.baseline_m / config.nearest_m
        near = (disparity >= config.least_disparity_px) & (disparity <= most)
        near &= np.abs(np.log(left.scale[k] / right.scale[m])) <= np.log(config.scale_ratio)
        near &= np.cos(left.orientation[k] - right.orientation[m]) >= np.cos(config.turn_rad)
        pairs = k[near], m[near]
        matches = match_pairs(left.descriptors, right.descriptors, pairs, config.limits)
        # Of matches that share a pixel position the one with the nearest descriptor, in the order of `left`.
        order = np.argsort(matches.distance, kind="stable")
        for keypoints, rows in ((left, matches.first), (right, matches.second)):
            _, first = np.unique(keypoints.px[rows[order]], axis=0, return_index=True)
            order = order[np.sort(first)]
        return matches.take(np.sort(order))

    def check(self, left: np.ndarray, right: np.ndarray) -> None:
        """Refuses images that these cameras cannot have taken.

        Raises InputError: they are not (H, W) uint8, or not of the camera's size.
        """
        left, right, camera = checked_image(left), checked_image(right), self.rig.camera
        one, other = (f"{image.shape[1]}x{image.shape[0]} px" for image in (left, right))
        if one != other:
            raise InputError(f"left and right image must be of one size, got {one} and {other}: give a rectified pair")
        if left.shape != (camera.height, camera.width):
            raise InputError(f"the camera takes {camera.width}x{camera.height} px, the images have {one}")


def first_views(image: np.ndarray, z: Array, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`StereoFeatures.patch` and `first` of keypoints (K, 3), with orientations (K,), cut from the left image."""
    side = 2 * PATCH_HALF_PX + 1
    patch, pixel = np.zeros((len(z), side, side), np.uint8), np.rint(z[:, :2]).astype(np.int64)
    first = np.column_stack([z[:, :2] - pixel, z[:, 0] - z[:, 2], orientation])
    whole = _inside(image, pixel[:, 0], pixel[:, 1], PATCH_HALF_PX)
    first[~whole] = 0.0
    if whole.any():
        column, line = (pixel[whole] - PATCH_HALF_PX).T
        patch[whole] = np.lib.stride_tricks.sliding_window_view(image, (side, side))[line, column]
    return patch, first


def aligned(
    rig: RectifiedStereo,
    config: PairConfig,
    images: tuple[np.ndarray, np.ndarray],
    offset_px: float,
    features: StereoFeatures,
    rows: np.ndarray,
    patch: np.ndarray,
    first: np.ndarray,
) -> StereoFeatures:
    """Aligns re-observed features with their first views in the left image, and measures them there.

    A window whose correlation is too low is not matched: its point keeps the keypoint's pixel and noise, and its first view
    is replaced by the current one.

    Args:
        rig: the two cameras.
        config: settings of the matching.
        images: left and right, (H, W) uint8.
        offset_px: known offset of the right image's columns, already subtracted from the features.
        features: of the pair.
        rows: (k,) indices of the re-observed features.
        patch: (k, S, S) uint8 their first views, as `StereoFeatures.patch`.
        first: (k, 4), as `StereoFeatures.first`.
    """
    if not patch.size:
        return features
    px, disparity = features.z[rows, :2], features.z[rows, 0] - features.z[rows, 2]
    has_view = (first[:, 2] > 0.0) & (disparity > 0.0)
    # The disparity gives the change of scale of each point; the median over all points gives the image rotation, as a
    # single keypoint's orientation is off by several degrees.
    turn = first[:, 3] - features.orientation[rows]
    turn = np.median((turn + np.pi) % (2.0 * np.pi) - np.pi)
    turn = 0.0 if abs(turn) < LEAST_TURN_RAD * max(1.0, 3.0 / np.sqrt(rows.size)) else turn
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    growth = np.where(has_view, disparity, 1.0) / np.where(has_view, first[:, 2], 1.0)
    offset = growth[:, None] * (first[:, :2] @ rotation)
    templates = warp(patch, rotation / growth[:, None, None], TEMPLATE_PX)
    cov = np.tile(KEYPOINT_PX**2 * np.eye(2), (rows.size, 1, 1))
    match = search(images[0], templates, px - offset, cov, sigmas=3.0)
    found = has_view & (match.score >= config.least_correlation) & np.isfinite(match.cov).all(axis=(1, 2))
    place = np.where(found[:, None], match.px + offset, px)
    # The disparity is measured anew at the aligned pixel.
    start = place[:, 0] - disparity
    u, correlation = refine(*images, place, start + offset_px, config.half_px)
    u -= offset_px
    found &= (np.abs(u - start) <= config.shift_px) & (correlation >= config.least_correlation)
    z, noise, views = features.z.copy(), features.cov.copy(), (features.patch.copy(), features.first.copy())
    z[rows[found]] = np.column_stack([place, u])[found]
    exact = config.aligned_px**2 * np.eye(2) + config.aligned_residual**2 * match.cov
    scale = features.scale[rows]
    noise[rows] = np.where(found[:, None, None], config.noise(scale, exact), config.noise(scale))
    views[0][rows[found]], views[1][rows[found]] = patch[found], first[found]
    return replace(features, patch=views[0], first=views[1]).at(rig, z, noise)


ITERATIONS = 5  #: Gauss-Newton steps; keypoints start within a pixel of the solution, where three suffice.
LONGEST_PX = 1.0  #: Largest step.
_TINY = 1e-9


def refine(
    left: np.ndarray, right: np.ndarray, px: np.ndarray, u_right: np.ndarray, half_px: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Refines columns u_right (K,) of the right image, good to a pixel or two, that match left pixels px (K, 2).

    The window has 2 half_px + 1 pixels along each side; images are (H, W) uint8.

    Returns:
        Columns (K,), NaN where a window reaches beyond its image; the normalised correlation (K,) of the two windows, −1 to 1,
        0 without a column or texture.
    """
    u, v = u_right.astype(float), px[:, 1]
    template = _centred(_windows(left, px[:, 0], v, half_px, half_px))
    energy = np.maximum(_dot(template, template), _TINY)
    for _ in range(ITERATIONS):
        wide = _windows(right, u, v, half_px, half_px + 1)
        slope = _centred(0.5 * (wide[:, :, 2:] - wide[:, :, :-2]))
        window = _centred(wide[:, :, 1:-1])
        gain = _dot(template, window) / energy
        miss = gain[:, None, None] * template - window
        step = _dot(slope, miss) / np.maximum(_dot(slope, slope), _TINY)
        u = u + np.clip(step, -LONGEST_PX, LONGEST_PX)
    window = _centred(_windows(right, u, v, half_px, half_px))
    correlation = _dot(template, window) / np.sqrt(energy * np.maximum(_dot(window, window), _TINY))
    whole = _inside(left, px[:, 0], v, half_px) & _inside(right, u, v, half_px)
    return np.where(whole, u, np.nan), np.where(whole, correlation, 0.0)


def _windows(image: np.ndarray, u: np.ndarray, v: np.ndarray, high: int, wide: int) -> np.ndarray:
    """(K, 2 high + 1, 2 wide + 1) float32 interpolated at subpixel positions; border pixels are repeated beyond the image."""
    column, line = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    across = (u - column).astype(np.float32)[:, None, None]
    down = (v - line).astype(np.float32)[:, None, None]
    columns = np.clip(column[:, None] + np.arange(-wide, wide + 2), 0, image.shape[1] - 1)
    lines = np.clip(line[:, None] + np.arange(-high, high + 2), 0, image.shape[0] - 1)
    pixels = image[lines[:, :, None], columns[:, None, :]].astype(np.float32)
    pixels = pixels[:, :-1] + down * (pixels[:, 1:] - pixels[:, :-1])
    return pixels[:, :, :-1] + across * (pixels[:, :, 1:] - pixels[:, :, :-1])


def _centred(windows: np.ndarray) -> np.ndarray:
    return windows - windows.mean(axis=(1, 2), keepdims=True)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("kij,kij->k", a, b)


def _inside(image: np.ndarray, u: np.ndarray, v: np.ndarray, half_px: int) -> np.ndarray:
    height, width = image.shape
    across = (u >= half_px) & (u <= width - 1 - half_px)
    return across & (v >= half_px) & (v <= height - 1 - half_px)
