"""Active search (E06 §4.1): selection of features, their predicted positions, and matching.

A false match inside its search ellipse cannot be recognised as false before the pose is known, and then it is too late. So an
`OutlierGate` selects the matches that agree with one motion of the camera; the others are not used in the filter's step.
"""

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, final

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Belief
from rbpf.kernels.dense import fit_robustly
from rbpf.sensors.patches.search import cut, search, warp
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.feature_table import FeatureTable, parallax, patch_affines, tilted

CELLS = 6  #: Columns and rows of the image grid, from whose cells features are selected in turn.
AMBIGUOUS = 0.9  #: Two positions are ambiguous if the lower score is at least this fraction of the higher one.
MIN_AGREEING = 4  #: Least inliers of a motion for it to predict the other features.
WIDEST = 2.0  #: Ratio of an ellipse to the searched part of it beyond which it does not count as searched.
#: Half-width of the window from which a patch's orientation is learnt; weights halve at half of it.
PLANE_HALF_PX = 7
#: Learning ends once the remaining uncertainty moves the patch's border by less than this, in standard deviations.
SHOWN_PX = 0.1
ROUNDING = 1.0 / 6.0  #: Variance of the difference of two grey levels that were rounded.
_OFFSETS = np.stack(np.meshgrid(*2 * [np.arange(-PLANE_HALF_PX, PLANE_HALF_PX + 1.0)]), axis=-1)
_WEIGHTS = 0.5 ** (np.square(2.0 * _OFFSETS / PLANE_HALF_PX).sum(axis=-1)).ravel()
ROUNDS = 10  #: Reweightings of the robust fit.
CAUCHY_SCALE = 2.0  #: Residual of the robust fit, in standard deviations, at which a match has half weight.


class MotionFit(NamedTuple):
    """A motion that most of K matches agree on: an increment ε of the heaviest particle's predicted pose."""

    squared: np.ndarray  #: (K,) squared Mahalanobis distance of each match from it.
    increment: np.ndarray  #: (d,) ε.
    cov: np.ndarray  #: (d, d) of ε.


class OutlierGate(ABC):
    """Estimates the motion that most matches of a frame agree on."""

    @abstractmethod
    def fit(
        self, nu: np.ndarray, jac: np.ndarray, cov: np.ndarray, factor: np.ndarray, trusted: np.ndarray
    ) -> MotionFit:
        """The motion that most trusted ones of K matches agree on, and the distances of all matches from it.

        Args:
            nu: (K, p) innovations at the predicted pose.
            jac: (K, p, d) by the pose, H.
            cov: (K, p, p) of the innovations given the pose, S = J P Jᵀ + R.
            factor: (d, r) of the prior's covariance, Q = L Lᵀ.
            trusted: (K,) which determine the motion; the others are only tested against it.
        """


@final
class RobustMotionGate(OutlierGate):
    """Maximum a posteriori of ε ~ N(0, Q) with a Cauchy loss on the Mahalanobis distances of the matches.

    Iteratively reweighted least squares. The fit also predicts features that were not matched: among similar ones (the
    corners of a chessboard, a row of windows) the right one is then nearest.
    """

    def fit(
        self, nu: np.ndarray, jac: np.ndarray, cov: np.ndarray, factor: np.ndarray, trusted: np.ndarray
    ) -> MotionFit:
        # u ~ N(0, I) with ε = L u, for whitened measurements; the weights are from the previous residuals.
        rows = np.concatenate([nu[trusted, :, None], jac[trusted] @ factor], axis=2)
        rows = np.linalg.solve(gaussian.cholesky(cov[trusted]), rows)
        white, slope = np.ascontiguousarray(rows[..., 0]), np.ascontiguousarray(rows[..., 1:])
        u, info = np.empty(factor.shape[1]), np.empty((factor.shape[1],) * 2)
        fit_robustly(white, slope, ROUNDS, CAUCHY_SCALE, u, info)
        increment, spread = factor @ u, gaussian.symmetrise(factor @ np.linalg.solve(info, factor.T))
        squared = np.empty(nu.shape[0])
        squared[trusted] = np.square(white - slope @ u).sum(axis=1)
        if trusted.all():
            return MotionFit(squared, increment, spread)
        jac, cov, off = jac[~trusted], cov[~trusted], (nu - jac @ increment)[~trusted]
        given = cov + jac @ spread @ np.swapaxes(jac, -1, -2)
        squared[~trusted] = (off * np.linalg.solve(given, off[..., None])[..., 0]).sum(axis=-1)
        return MotionFit(squared, increment, spread)


_EMPTY_PX = partial(np.zeros, (0, 2))


@dataclass(frozen=True)
class SearchResult:
    """The result of the search in a frame, K features."""

    features: np.ndarray = field(default_factory=partial(np.zeros, 0, np.int64))  #: (K,) their rows in the table.
    mean: np.ndarray = field(default_factory=_EMPTY_PX)  #: (K, 2) predicted pixels.
    #: (K, 2, 2) covariance of the prediction, with measurement noise, px².
    cov: np.ndarray = field(default_factory=partial(np.zeros, (0, 2, 2)))
    px: np.ndarray = field(default_factory=_EMPTY_PX)  #: (K, 2) best match of each; NaN where nothing was compared.
    score: np.ndarray = field(default_factory=partial(np.zeros, 0))  #: (K,) its normalised cross-correlation.
    found: np.ndarray = field(default_factory=partial(np.zeros, 0, np.bool_))  #: (K,) whether it was accepted.
    #: (K,) whether another position in the ellipse matches about as well.
    ambiguous: np.ndarray = field(default_factory=partial(np.zeros, 0, np.bool_))
    #: (V, 2) predicted pixels of all features in view, selected or not.
    in_view: np.ndarray = field(default_factory=_EMPTY_PX)
    seconds_choosing: float = 0.0  #: time of the selection, the only part that grows with the map.


@final
class ActiveSearch:
    """Searches the features of a table, whose rows are their names; by default with a `RobustMotionGate`."""

    def __init__(
        self, features: FeatureSensor, table: FeatureTable, config: SearchConfig, gate: OutlierGate | None = None
    ) -> None:
        self.features = features
        self.table, self.config = table, config
        self.gate = gate or RobustMotionGate()
        #: Whether in a frame of the start most matches had too uncertain depths to be predicted.
        self.is_fast = False

    @property
    def noise(self) -> np.ndarray:
        """Covariance (2, 2) of a match, px²; as learnt, but at least as stated, so that no ellipse is too small."""
        return max(self.features.noise_factor, 1.0) * self.config.noise_px**2 * np.eye(2)

    def run(self, image: np.ndarray, belief: Belief, starting: bool = False) -> SearchResult:
        """Searches features in an image (H, W) uint8; accepted matches agree with one motion of the camera.

        During the start of a fast camera (`starting`) features of any depth count if their match is unambiguous.
        """
        pose = self.features.pose(belief)
        started = time.perf_counter()
        rows, in_view = self.choose(pose)
        seconds_choosing = time.perf_counter() - started
        if not rows.size:
            return SearchResult(in_view=in_view, seconds_choosing=seconds_choosing)

        # Each is searched in the ellipse predicted by all particles together, with its first appearance.
        which, mean, cov = self.features.project(belief, rows)
        rows, cov = rows[which], cov + self.noise
        affines = self.first_affines(rows, pose)
        templates = warp(self.table.first_patch[rows], affines, self.config.template_px)
        matches = self.match(image, templates, mean, cov)
        result = SearchResult(rows, mean, cov, *matches, in_view, seconds_choosing)

        # Unmatched features are searched again with their last appearance. As long as a patch's orientation is unknown, it is
        # assumed to face the first camera, and is recognised up to about 25° from there.
        changed = (self.table.last_pose[rows] != self.table.first_pose[rows]).any(axis=1)
        missed = np.flatnonzero(~result.found & changed)
        if missed.size:
            table, again = self.table, rows[missed]
            affines = patch_affines(self.features.camera, table.position[again], table.last_pose[again], pose)
            later = warp(table.last_patch[again], affines, self.config.template_px)
            px, score, found, ambiguous = self.match(image, later, mean[missed], cov[missed])
            better = score > result.score[missed]
            chosen = missed[better]
            templates[chosen] = later[better]
            result.px[chosen], result.score[chosen] = px[better], score[better]
            result.found[chosen], result.ambiguous[chosen] = found[better], ambiguous[better]
        if result.found.any():
            result = self._agreeing(image, belief, templates, result, starting)
            if self.config.planes == "learnt":
                self._learn_planes(image, pose, result.features[result.found], result.px[result.found])
        return result

    def choose(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Selects features (K,) to search from a pose, spread over the image; and pixels (V, 2) of all in view."""
        table, camera, config = self.table, self.features.camera, self.config
        rows, px = self.in_view(pose, table.alive)

        # The best feature of each image cell, then the second best of each, and so on.
        size = np.array([camera.width, camera.height])
        column, line = np.clip(px * CELLS / size, 0, CELLS - 1).astype(np.int64).T
        cell = column + CELLS * line
        worth = table.found_fraction(rows) - 0.2 * table.missed[rows]
        order = np.lexsort((-worth, cell))
        _, first = np.unique(cell[order], return_index=True)
        rank = np.arange(order.size) - np.repeat(first, np.diff(np.append(first, order.size)))
        best_first = order[np.lexsort((-worth[order], rank))]
        return np.asarray(rows[best_first[: config.measurements]]), px

    def in_view(self, pose: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (V,) of features `among` (F,) bool in view of a pose under similar conditions; and their pixels (V, 2)."""
        from rbpf.sensors.camera.kernels import in_view

        table, camera, config = self.table, self.features.camera, self.config
        of_image = (camera.width, camera.height, config.border_px, camera.lens.monotonic_radius)
        limits = np.array([*of_image, np.cos(np.deg2rad(config.max_turn_deg)), config.max_scale_change], dtype=float)
        rows, px = np.empty(len(table), dtype=np.int64), np.empty((len(table), 2))
        columns = (table.position, table.first_pose, among)
        count = in_view(*columns, np.ascontiguousarray(pose), camera.params, limits, rows, px)
        return rows[:count], px[:count]

    def first_affines(self, rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """∂(pixel in the first patch)/∂(pixel from a pose) (K, 2, 2) of features (K,)."""
        table, camera = self.table, self.features.camera
        places = (camera, table.position[rows], table.first_pose[rows], pose)
        facing = patch_affines(*places)
        if self.config.planes == "facing":
            return facing
        return tilted(facing, parallax(*places), table.slopes(rows) / camera.params[:2])

    def match(
        self, image: np.ndarray, templates: np.ndarray, mean: np.ndarray, cov: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position (K, 2), score (K,), whether it is a match (K,), and whether it is ambiguous (K,)."""
        config = self.config
        matches = search(image, templates, mean, cov, sigmas=config.ellipse_sigmas, most_px=config.max_radius_px)
        accepted = (matches.score >= config.min_correlation) & self.features.camera.inside(matches.px)
        return matches.px, matches.score, accepted, matches.ratio >= AMBIGUOUS

    def _agreeing(
        self, image: np.ndarray, belief: Belief, templates: np.ndarray, result: SearchResult, starting: bool
    ) -> SearchResult:
        """Keeps matches that agree with one motion; others are searched again where the motion predicts them."""
        hits = np.flatnonzero(result.found)
        which, nu, jac, cov = self._innovations(belief, result.features[hits], result.px[hits])
        factor = belief.prior.spread(belief.prior.mean)
        factor = np.asarray(factor[belief.mode if factor.shape[0] > 1 else 0])
        voting = self.table.voting(result.features[hits[which]], self.config.trusted_fraction)
        fit = self.gate.fit(nu, jac, cov, factor, voting)
        found, hits = np.zeros_like(result.found), hits[which]
        agree, placed = fit.squared <= self.config.gate_chi2, self._well_predicted(cov)
        self.is_fast |= starting and 2 * int((agree & placed).sum()) < int(agree.sum())
        if starting and self.is_fast:
            placed |= ~result.ambiguous[hits]
        found[hits[agree & placed]] = True
        result = replace(result, found=found)
        missed = np.flatnonzero(result.ambiguous & ~found)
        if found.sum() < MIN_AGREEING or not missed.size:
            return result

        which, nu, jac, cov = self._innovations(belief, result.features[missed], result.mean[missed])
        placed = self._well_predicted(cov)
        missed, nu, jac, cov = missed[which[placed]], nu[placed], jac[placed], cov[placed]
        if missed.size:
            mean = result.mean[missed] - nu + jac @ fit.increment
            cov = cov + jac @ fit.cov @ np.swapaxes(jac, -1, -2)
            px, score, again, _ = self.match(image, templates[missed], mean, cov)
            result.px[missed], result.score[missed], found[missed] = px, score, again
        return result

    def _learn_planes(self, image: np.ndarray, pose: np.ndarray, rows: np.ndarray, px: np.ndarray) -> None:
        """Learns the orientation of the patches of features (K,) matched at px (K, 2) from their appearance.

        A Gauss-Newton step for the plane's slope, with nuisance parameters position, gain and offset of the patch
        (N. Molton, A. Davison and I. Reid, Locally planar patch features, 2004).
        """
        table, focal = self.table, self.features.camera.params[:2]
        affines = self.first_affines(rows, pose)
        along = parallax(self.features.camera, table.position[rows], table.first_pose[rows], pose)
        squared, slopes = np.square(along).sum(axis=1), table.slopes(rows)
        least = np.linalg.eigvalsh(table.plane_information[rows, :, :2])[:, 0] + 1.0
        tells = PLANE_HALF_PX**2 * squared > SHOWN_PX**2 * focal.mean() ** 2 * least
        windows = {k: cut(image, px[k], PLANE_HALF_PX) for k in np.flatnonzero(tells).tolist()}
        chosen = [k for k, window in windows.items() if window is not None]
        if not chosen:
            return
        rows, affines, along, squared, slopes = (part[chosen] for part in (rows, affines, along, squared, slopes))
        wide = warp(table.first_patch[rows], affines, 2 * PLANE_HALF_PX + 3).astype(float)
        inner = (slice(None), slice(1, -1), slice(1, -1))
        expected, down, across = wide[inner], *(part[inner] for part in np.gradient(wide, axis=(1, 2)))
        shift = across * along[:, 0, None, None] + down * along[:, 1, None, None]
        by_slope = -shift[..., None] * (_OFFSETS @ np.swapaxes(affines, 1, 2)[:, None]) / focal
        columns = [by_slope[..., 0], by_slope[..., 1], across, down, np.ones_like(expected), expected]
        by_all = np.stack(columns, axis=-1).reshape(rows.size, -1, 6)
        error = (np.array([windows[k] for k in chosen], dtype=float) - expected).reshape(rows.size, -1)
        usable = np.isfinite(by_all).all(axis=(1, 2))
        rows, by_all, error, squared, slopes = (part[usable] for part in (rows, by_all, error, squared, slopes))
        weighted = np.swapaxes(_WEIGHTS[:, None] * by_all, 1, 2)
        normal, right = weighted @ by_all, weighted @ error[..., None]
        # Where grey levels vary in one direction only, the position across it is undetermined.
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        left = (error[..., None] - by_all @ np.linalg.solve(normal, right))[..., 0]
        variance = np.square(left) @ _WEIGHTS / _WEIGHTS.sum() + ROUNDING
        others = normal[:, :2, 2:] @ np.linalg.inv(normal[:, 2:, 2:])
        info = (normal[:, :2, :2] - others @ normal[:, 2:, :2]) / variance[:, None, None]
        vector = (right[:, :2] - others @ right[:, 2:]) / variance[:, None, None] + info @ slopes[..., None]
        table.plane_information[rows] += np.concatenate([info, vector], axis=2)
        total, greatest = table.squared_parallax[rows].T
        table.squared_parallax[rows] = np.column_stack([total + squared, np.maximum(greatest, squared)])

    def _innovations(
        self, belief: Belief, rows: np.ndarray, px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the features used, and their ν, H and S in the heaviest particle; see `FeatureSensor.innovations`."""
        which, nu, jac, cov = self.features.innovations(belief, rows, px)
        return which, nu, jac, cov + self.noise

    def _well_predicted(self, cov: np.ndarray) -> np.ndarray:
        """Mask of features (K,) whose prediction given the camera's motion is precise relative to the search range.

        A feature of more uncertain depth, cov (K, 2, 2) given the camera, agrees with every motion: several similar positions
        cannot be disambiguated.
        """
        # The larger eigenvalue of each.
        middle, apart = 0.5 * (cov[:, 0, 0] + cov[:, 1, 1]), 0.5 * (cov[:, 0, 0] - cov[:, 1, 1])
        own = self.config.ellipse_sigmas * np.sqrt(middle + np.hypot(apart, cov[:, 0, 1]))
        return np.asarray(own <= WIDEST * self.config.max_radius_px)
