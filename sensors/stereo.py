"""Features of a rectified stereo pair (S05 §III-B), those of both images matched along the rows; the left camera leads.

Impulse noise, salt and pepper, is taken out before (`remove_impulses`): single corrupted pixels, which SIFT takes for blobs.

A keypoint of the left image may match those of the right one that lie on its row, to the left of it by a disparity
that a depth beyond the nearest has, at a like scale and orientation. Of these candidates the nearest descriptor is taken
(`rbpf.sensors.descriptors`), and the place in the right image is refined on grey values (`refine`): a window
around the left place is moved along the row of the right image until the squared difference of the two is least,
brightness and contrast left free (Gauss-Newton; B. Lucas, T. Kanade 1981, in one dimension).

The noise of z = (u_left, v, u_right): what a keypoint's place means on the object changes from view to view, with
standard deviation σ_p per axis. The refinement looks for what lies at the left place, whatever that is: u_right shares
the error of u_left and adds that of the disparity, σ_d. Both grow with the keypoint's scale,

    cov = [[σ_p², 0, σ_p²], [0, σ_p², 0], [σ_p², 0, σ_p² + σ_d²]],    Mathematics (stereo-noise).

Without the refinement both places have their own error, and cov = σ_p² I.

So a point that is known again can be put where its first view is (`aligned`): the window around its first place, enlarged as
its disparity has grown and turned as the keypoints have, is looked for about the keypoint (`rbpf.sensors.patches`). What
its place means is then the same in all views, and σ_p² a 2 × 2 covariance: that of the alignment, by its residual.
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
PATCH_HALF_PX, TEMPLATE_PX = 15, 15  #: Of a first view, beside its middle; and the side of what is looked for.
KEYPOINT_PX = 1.0  #: Standard deviation of a keypoint from its first view, for the search; mostly it is 0.3 to 0.7.
LEAST_TURN_RAD = 0.1  #: A smaller turn of the image is not made up for: the orientations' median errs by as much.
TOLERATED_FRACTION = 0.001  #: Fraction of isolated pixels up to which an image is left as it is.


def remove_impulses(image: np.ndarray) -> tuple[np.ndarray, float]:
    """An image (H, W) uint8 without corrupted pixels, and the fraction of the pixels that were replaced.

    A lens spreads a point over neighbouring pixels, so that no camera sees one that differs from all its neighbours. Where
    more pixels do than a few specks explain, those that stick out are replaced by the median of their surroundings; all
    others stay as they are to the byte. The dots of a pattern projector look like impulses: a rig that has one should run
    with `pair.filter_impulses=False`.
    """
    import cv2

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)
    above = cv2.subtract(image, cv2.dilate(image, ring))
    below = cv2.subtract(cv2.erode(image, ring), image)
    if ((above > LEAP) | (below > LEAP)).mean() <= TOLERATED_FRACTION:
        return image, 0.0
    # Corrupted pixels beside one another are no peaks, but at the edge of what is around them.
    median = cv2.medianBlur(image, 3)
    edge = (image >= cv2.dilate(image, ring)) | (image <= cv2.erode(image, ring))
    corrupted = edge & (cv2.absdiff(image, median) > LEAP)
    return np.where(corrupted, median, image), float(corrupted.mean())


@final
@dataclass(frozen=True)
class StereoFeatures(RowByRow):
    """What a pair of images shows, of highest contrast first: the local landmarks {P^L, C^L, α, s, f} of S05 §III-B."""

    z: np.ndarray  #: (K, 3) pixels (u_left, v, u_right).
    cov: np.ndarray  #: (K, 3, 3) of their noise, px².
    points: np.ndarray  #: (K, 3) P^L in the left camera's frame, m.
    cov_points: np.ndarray  #: (K, 3, 3) C^L, m²: `cov` through the Jacobian of the triangulation.
    scale: np.ndarray  #: (K,) of the keypoint, px.
    orientation: np.ndarray  #: (K,) of the keypoint, radians.
    descriptors: np.ndarray  #: (K, 36) or (K, 128) float32 of length 1.
    #: (K, S, S) uint8, each point's first view: the left image around the pixel where it was seen first; S = 0 where
    #: places are those of the keypoints.
    patch: np.ndarray
    #: (K, 4) place in that, from its middle, and the disparity, px; orientation, radians. The disparity is 0 where a point has
    #: no first view, too near the border.
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
        """Features whose points and their covariances follow from the pixels; by default without first views."""
        points = rig.triangulate(z)
        jac = np.linalg.inv(rig.jacobian(points))  # Mathematics (stereo-slope)
        cov_points = gaussian.symmetrise(jac @ cov @ np.swapaxes(jac, -1, -2))
        patch = np.zeros((len(z), 0, 0), np.uint8) if patch is None else patch
        first = np.zeros((len(z), 4)) if first is None else first
        return cls(z, cov, points, cov_points, scale, orientation, descriptors, patch, first)

    def at(self, rig: RectifiedStereo, z: Array, cov: Array) -> "StereoFeatures":
        """The same ones at other pixels (K, 3), with covariances (K, 3, 3)."""
        return self.measured(rig, z, cov, self.scale, self.orientation, self.descriptors, self.patch, self.first)


SWAPPED, FEWER = 20, 4  #: So many matches the wrong way round, and so many times fewer the right way, are no accident.
#: So many matches the wrong way round, and such a fraction of all, are no accident either: of KITTI's it is below 0.01.
IMPOSSIBLE, FRACTION = 5, 0.03
REMEMBERED = 0.9  #: Of the matches that were counted, what still counts a pair later: some ten pairs decide.


@dataclass(frozen=True)
class PairConfig(Ranged):
    """How the two images are matched, and how exact the result is. Raises InputError: a number is out of its range."""

    row_px: NotNegative = 1.0  #: rows of a match differ by at most this …
    row_per_scale: NotNegative = 0.25  #: … and this fraction of the keypoint's scale.
    nearest_m: Positive = 0.3  #: least depth; disparities above that of this depth are left out.
    least_disparity_px: Positive = 1.0  #: nor does a smaller disparity than this tell a depth.
    scale_ratio: Ratio = 1.5  #: largest ratio of the two scales.
    turn_rad: Annotated[float, Range(gt=0.0, le=7.0)] = 0.35  #: largest difference of the two orientations.
    limits: MatchLimits = field(default_factory=MatchLimits)  #: of the descriptors.
    #: whether impulse noise (salt and pepper) is removed before keypoints are detected.
    filter_impulses: Annotated[bool, Formerly("mend")] = True
    refine: bool = True  #: whether the disparity is refined on grey values.
    half_px: Annotated[int, Range(ge=1, le=100)] = 5  #: of the refinement's window.
    #: of the refined windows, else the match is dropped.
    least_correlation: Annotated[float, Range(ge=-1.0, le=1.0)] = 0.8
    shift_px: Positive = 2.0  #: nor may the refinement move it further than this.
    align: bool = True  #: whether points that are known again are put where their first view is, with `refine`.
    aligned_px: Positive = 0.05  #: σ_p of first views, and of an alignment …
    aligned_residual: Positive = 2.0  #: … in quadrature with so many times what its residual explains.
    place_px: Positive = 0.25  #: σ_p of a keypoint of scale 0 …
    place_per_scale: NotNegative = 0.02  #: … and what is added to it in quadrature, as a fraction of the scale.
    disparity_px: Positive = 0.1  #: σ_d of a keypoint of scale 0 …
    disparity_per_scale: NotNegative = 0.025  #: … and what is added to it in quadrature.

    def noise(self, scale: np.ndarray, place: np.ndarray | None = None) -> np.ndarray:
        """Covariances (K, 3, 3) of (u_left, v, u_right) of keypoints of scales (K,), px².

        Those (K, 2, 2) of the left places are `place`, by default what a keypoint of such a scale has.
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
    """In words, why matches, so many of them of negative disparity, are not of such cameras; empty where they may be."""
    if wrong < IMPOSSIBLE or wrong <= FRACTION * matches:
        return ""
    fraction = f"{100.0 * wrong / matches:.0f} % of the matches"
    return f"{fraction} have a negative disparity, which no point in space has: check the calibration"


@final
class StereoMatcher:
    """Measures pairs of images.

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
        self.rows_px = 0.0  #: By how many rows the last pair is not rectified.
        #: By which columns of the right image are known to be too large: they are measured without it.
        self.offset_px = 0.0
        self._last: tuple[tuple[np.ndarray, np.ndarray], Features, Features, int] | None = None

    def measure(self, left: np.ndarray, right: np.ndarray) -> StereoFeatures:
        """Features of a pair of images (H, W) uint8; none where there is no texture.

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
        """Matches of the last pair whose disparity is negative, as good as the others, and all of its matches.

        Nothing is further away than infinity: such are those of cameras that are turned or shifted against each other.
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
        """In words, what was wrong with the last pair; empty where nothing was."""
        found = list[str]()
        if self.impulse_fraction:
            fraction = f"{100.0 * self.impulse_fraction:.1f} %"
            found += [f"{fraction} of the pixels have impulse noise, the median of their surroundings is taken"]
        if self.rows_px:
            where = f"{abs(self.rows_px):.1f} rows {'lower' if self.rows_px > 0.0 else 'higher'} in the right image"
            found += [f"the pair is not rectified: things are {where}; rectify the images by the cameras' calibration"]
        return "; ".join(found)

    def match(self, images: tuple[np.ndarray, np.ndarray], left: Features, right: Features) -> StereoFeatures:
        """Features of a pair of images whose keypoints are known. Raises InputError: the images are swapped."""
        matches = self._along_rows(left, right)
        self.rows_px = 0.0
        # A pair is refused whose keypoints match far better the other way round, and one told that does on other rows.
        if FEWER * len(matches) < min(len(left), len(right)):
            swapped = len(self._along_rows(right, left))
            if swapped >= SWAPPED and swapped > FEWER * len(matches):
                raise InputError(
                    f"left and right image seem to be swapped: {swapped} matches have a negative disparity and "
                    f"{len(matches)} a positive one; exchange the two cameras, unless one of them has frozen"
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
        """Which places px (K, 2) of the left image are found near columns u (K,) of the right one, and where."""
        config = self.config
        if not (config.refine and u.size):
            return np.ones(u.size, dtype=bool), u
        found, correlation = refine(*images, px, u, config.half_px)
        return (np.abs(found - u) <= config.shift_px) & (correlation >= config.least_correlation), found

    def _along_rows(self, left: Features, right: Features) -> DescriptorMatches:
        """Matches of one keypoint of each image at most; a place that has two orientations counts once."""
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
        # Of those that share their place in an image the nearest descriptors, in the order of the first.
        order = np.argsort(matches.distance, kind="stable")
        for keypoints, rows in ((left, matches.first), (right, matches.second)):
            _, first = np.unique(keypoints.px[rows[order]], axis=0, return_index=True)
            order = order[np.sort(first)]
        return matches.take(np.sort(order))

    def check(self, left: np.ndarray, right: np.ndarray) -> None:
        """Refuses images that these cameras cannot have taken.

        Raises InputError: they are no (H, W) uint8, or not of the camera's size.
        """
        left, right, camera = checked_image(left), checked_image(right), self.rig.camera
        one, other = (f"{image.shape[1]}x{image.shape[0]} px" for image in (left, right))
        if one != other:
            raise InputError(f"left and right image must be of one size, got {one} and {other}: give a rectified pair")
        if left.shape != (camera.height, camera.width):
            raise InputError(f"the camera takes {camera.width}x{camera.height} px, the images have {one}")


def first_views(image: np.ndarray, z: Array, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`StereoFeatures.patch` and `first` of keypoints (K, 3), with orientations (K,), in the left image they are seen in."""
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
    """Features of which some are put where their first views are in the left image, and measured there.

    A window whose correlation is too low is not found: its point stays where the keypoint is, with that one's noise, and
    begins anew with its own view.

    Args:
        rig: the two cameras.
        config: settings of the matching.
        images: left and right, (H, W) uint8.
        offset_px: by which columns of the right one are known to be too large: the features are without it.
        features: of the pair.
        rows: (k,) of those that are known again.
        patch: (k, S, S) uint8 of these, as `StereoFeatures.patch`.
        first: (k, 4), as `StereoFeatures.first`.
    """
    if not patch.size:
        return features
    px, disparity = features.z[rows, :2], features.z[rows, 0] - features.z[rows, 2]
    has_view = (first[:, 2] > 0.0) & (disparity > 0.0)
    # How a view has grown is told by its disparity; by how much the camera has turned about its axis by all of them, as an
    # orientation is known to several degrees.
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
    # What lies there has its own disparity.
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


ITERATIONS = 5  #: Steps; a keypoint is within a pixel of its place, from where three are enough.
LONGEST_PX = 1.0  #: Of a step.
_TINY = 1e-9


def refine(
    left: np.ndarray, right: np.ndarray, px: np.ndarray, u_right: np.ndarray, half_px: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Refines columns u_right (K,), good to a pixel or two, at which places px (K, 2) of the left image are in the right one.

    The window has 2 half_px + 1 pixels along each side; images are (H, W) uint8.

    Returns:
        Columns (K,), NaN where a window reaches beyond its image; the normalised correlation (K,) of the two windows, −1 to 1,
        0 where there is no column or no texture.
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
    """(K, 2 high + 1, 2 wide + 1) float32 around places between pixels; the border goes on beyond the image."""
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
