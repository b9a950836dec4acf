"""Active search (E06 §4.1): which features are worth a look, where they should be, and what is there."""

import time
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from rbpf.core.belief import Belief
from rbpf.sensors.patches.search import search, warp
from rbpf.systems.mono.appearance import Appearances
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.consensus import Fit, fit_motion
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.viewing import affines

_CELLS = 6
"""The image is divided into so many columns and rows, from which features are chosen in turn."""

ALIKE = 0.9
"""Of two places one may be mistaken for the other when their scores differ by less than this fraction."""

ENOUGH = 4
"""Matches that must agree on a motion for it to say where the others are."""

TRUSTED = 6
"""Trusted matches that tell the motion alone: three determine it, and half of them may be wrong."""

WIDEST = 2.0
"""An ellipse larger than so many times what is searched of it is hardly searched at all."""


@dataclass(frozen=True)
class Searched:
    """What was looked for in a frame, K features.

    Attributes:
        rows: (K,) of the table.
        mean: (K, 2) predicted places, px.
        cov: (K, 2, 2) with the noise of the measurement.
        px: (K, 2) where each was found; NaN where not.
        score: (K,) normalised cross-correlation of the best match.
        found: (K,) whether it was accepted.
        alike: (K,) whether another place in the ellipse looks about as much like it.
    """

    rows: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    px: np.ndarray
    score: np.ndarray
    found: np.ndarray
    alike: np.ndarray

    @classmethod
    def nothing(cls) -> "Searched":
        """No feature."""
        none, places, false = np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=bool)
        return cls(np.zeros(0, dtype=np.int64), places, np.zeros((0, 2, 2)), places, none, false, false)


@final
class ActiveSearch:
    """Looks for the features of a table.

    Args:
        features: where the belief has them; a feature's name is its row in the table.
        table: what they look like.
        config: settings of the search.
    """

    def __init__(self, features: FeatureSensor, table: Appearances, config: SearchConfig) -> None:
        self.features, self.camera = features, features.camera
        self.table, self.config = table, config
        self.in_view = np.zeros((0, 2))
        """Places (V, 2) of all features that were worth a look, chosen or not, px."""
        self.seconds_choosing = 0.0
        """Time of the last choice of what to look for: all that grows with the map."""

    def run(self, image: np.ndarray, belief: Belief) -> Searched:
        """Looks for features in an image; what is found agrees with one motion of the camera."""
        pose = belief.state[belief.mode][:7]
        started = time.perf_counter()
        rows = self._choose(pose)
        self.seconds_choosing = time.perf_counter() - started
        if not rows.size:
            return Searched.nothing()
        rows, mean, cov = self._predict(rows, belief)
        cov = cov + self.config.noise_px**2 * np.eye(2)
        templates = self._templates(rows, self.table.source, self.table.first_pose, pose)
        searched = Searched(rows, mean, cov, *self._looked_for(image, templates, mean, cov))
        searched = self._by_last_look(image, templates, searched, pose)
        return self._agreeing(image, belief, templates, searched) if searched.found.any() else searched

    def _templates(
        self, rows: np.ndarray, sources: np.ndarray, poses: np.ndarray, pose: np.ndarray
    ) -> np.ndarray:
        """Windows (F, S, S) that were cut from poses (F, 7), of the rows, as they look from a pose."""
        turn = affines(self.camera, self.table.place[rows], poses[rows], pose)
        return warp(sources[rows], turn, self.config.template_px)

    def _by_last_look(
        self, image: np.ndarray, templates: np.ndarray, searched: Searched, pose: np.ndarray
    ) -> Searched:
        """What is not found as it looked at first is looked for as it looked later; changes its templates."""
        rows, table = searched.rows, self.table
        missed = np.flatnonzero(
            ~searched.found & (table.last_pose[rows] != table.first_pose[rows]).any(axis=1)
        )
        if not missed.size:
            return searched
        later = self._templates(rows[missed], table.last_source, table.last_pose, pose)
        px, score, found, alike = self._looked_for(image, later, searched.mean[missed], searched.cov[missed])
        better = score > searched.score[missed]
        chosen = missed[better]
        templates[chosen] = later[better]
        out = replace(
            searched, px=searched.px.copy(), score=searched.score.copy(),
            found=searched.found.copy(), alike=searched.alike.copy(),
        )  # fmt: skip
        out.px[chosen], out.score[chosen] = px[better], score[better]
        out.found[chosen], out.alike[chosen] = found[better], alike[better]
        return out

    def _looked_for(
        self, image: np.ndarray, templates: np.ndarray, mean: np.ndarray, cov: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Place (K, 2), score (K,), whether that is a match (K,), and whether another place is much alike (K,)."""
        sigmas, most = self.config.ellipse_sigmas, self.config.max_radius_px
        matches = search(image, templates, mean, cov, sigmas=sigmas, most_px=most)
        accepted = (matches.score >= self.config.min_correlation) & self.camera.inside(matches.px)
        return matches.px, matches.score, accepted, matches.ratio >= ALIKE

    def _agreeing(
        self, image: np.ndarray, belief: Belief, templates: np.ndarray, searched: Searched
    ) -> Searched:
        """Only matches that agree with one motion; what was mistaken is looked for again where the motion puts it."""
        hits = np.flatnonzero(searched.found)
        which, nu, jac, cov = self._innovations(belief, searched.rows[hits], searched.px[hits])
        trusted = self.trusted(searched.rows[hits[which]])
        fit = fit_motion(nu, jac, cov, self._prior_factor(belief), trusted)
        found = np.zeros_like(searched.found)
        found[hits[which[(fit.squared <= self.config.gate_chi2) & self._placed(cov)]]] = True
        searched = replace(searched, found=found)
        if found.sum() < ENOUGH:
            return searched
        return self._again(image, belief, templates, searched, fit)

    def trusted(self, rows: np.ndarray) -> np.ndarray:
        """Which features (K,) tell where the camera is, by their records; all of them where those are too few."""
        table = self.table
        kept = (table.member[rows] >= 0) | (table.found_fraction(rows) >= self.config.trusted_fraction)
        return kept if kept.sum() >= TRUSTED else np.ones(rows.size, dtype=bool)

    def _again(
        self, image: np.ndarray, belief: Belief, templates: np.ndarray, searched: Searched, fit: Fit
    ) -> Searched:
        """Looks again for what was mistaken for its like, near to where the motion of the others puts it."""
        missed = np.flatnonzero(searched.alike & ~searched.found)
        if not missed.size:
            return searched
        which, nu, jac, cov = self._innovations(belief, searched.rows[missed], searched.mean[missed])
        placed = self._placed(cov)
        missed, nu, jac, cov = missed[which[placed]], nu[placed], jac[placed], cov[placed]
        if not missed.size:
            return searched
        mean = searched.mean[missed] - nu + jac @ fit.increment
        cov = cov + jac @ fit.cov @ np.swapaxes(jac, -1, -2)
        px, score, found = searched.px.copy(), searched.score.copy(), searched.found.copy()
        px[missed], score[missed], found[missed], _ = self._looked_for(image, templates[missed], mean, cov)
        return replace(searched, px=px, score=score, found=found)

    def _placed(self, cov: np.ndarray) -> np.ndarray:
        """Which features (K,) are where the camera's motion puts them, up to what is searched.

        One with a depth more uncertain than that, cov (K, 2, 2) where the camera is known, agrees with every motion:
        which of several places that look alike is the right one cannot be told.
        """
        own = self.config.ellipse_sigmas * np.sqrt(np.linalg.eigvalsh(cov)[:, -1])
        return np.asarray(own <= WIDEST * self.config.max_radius_px)

    def _innovations(
        self, belief: Belief, rows: np.ndarray, px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Which of the features, ν, H, and S of them in the heaviest particle; see `FeatureSensor.innovations`."""
        which, nu, jac, cov = self.features.innovations(belief, rows, self.table.member[rows], px)
        return which, nu, jac, cov + self.config.noise_px**2 * np.eye(2)

    def _prior_factor(self, belief: Belief) -> np.ndarray:
        factor = belief.prior.spread(belief.prior.mean)
        return np.asarray(factor[belief.mode if factor.shape[0] > 1 else 0])

    def _choose(self, pose: np.ndarray) -> np.ndarray:
        """Rows of the features worth looking for, spread over the image (E06 §4.1)."""
        from rbpf.sensors.camera.kernels import in_view

        table, camera, config = self.table, self.camera, self.config
        of_image = (camera.width, camera.height, config.border_px, camera.monotonic_radius)
        limits = np.array(
            [*of_image, np.cos(np.deg2rad(config.max_turn_deg)), config.max_scale_change], dtype=float
        )
        rows, px = np.empty(table.count, dtype=np.int64), np.empty((table.count, 2))
        columns = (table.place, table.first_pose, table.alive)
        count = in_view(*columns, np.ascontiguousarray(pose), camera.params, limits, rows, px)
        rows, px = rows[:count], px[:count]
        size = np.array([self.camera.width, self.camera.height])
        column, line = np.clip(px * _CELLS / size, 0, _CELLS - 1).astype(np.int64).T
        cell = column + _CELLS * line
        self.in_view = px
        worth = table.found_fraction(rows) - 0.2 * table.missed[rows]
        order = np.lexsort((-worth, cell))
        _, first = np.unique(cell[order], return_index=True)
        rank = np.arange(order.size) - np.repeat(first, np.diff(np.append(first, order.size)))
        best_first = order[np.lexsort((-worth[order], rank))]
        return np.asarray(rows[best_first[: self.config.measurements]])

    def _predict(self, rows: np.ndarray, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows again, mean (K, 2) and covariance (K, 2, 2) of where they are under all particles, by kind."""
        done = [
            (chosen, *predicted)
            for chosen, predicted in self.features.project(belief, rows, self.table.member[rows])
        ]
        chosen, mean, cov = (np.concatenate(parts) for parts in zip(*done, strict=True))
        return rows[chosen], mean, cov
