"""Active search (E06 §4.1): the belief says where to look, and `FeatureSensor` takes what is there."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from rbpf.belief import Belief
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.models import Births, Observations, Sensor
from rbpf.sensors.corners import corners
from rbpf.sensors.features import FeatureFrame
from rbpf.sensors.patches import cut, search, warp
from rbpf.sensors.readers.images import ImageFrame
from rbpf.systems.mono.appearance import SOURCE_HALF_PX, Appearances
from rbpf.systems.mono.config import SearchConfig
from rbpf.systems.mono.consensus import agreeing
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.viewing import affines, directions, view_changes

_CELLS = 6
"""The image is divided into so many columns and rows, from which features are chosen in turn."""


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
    """

    rows: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    px: np.ndarray
    score: np.ndarray
    found: np.ndarray

    @classmethod
    def nothing(cls) -> "Searched":
        """No feature."""
        none, places = np.zeros(0), np.zeros((0, 2))
        return cls(np.zeros(0, dtype=np.int64), places, np.zeros((0, 2, 2)), places, none, none.astype(bool))


@final
class ImageSensor(Sensor):
    """Finds the features of the map in images, and new ones.

    Args:
        features: what turns found features into observations and landmarks; a feature's name is its row in `table`.
        config: settings of the search.
    """

    def __init__(self, features: FeatureSensor, config: SearchConfig) -> None:
        self.features = features
        self.camera = features.camera
        self.config = config
        self.table = Appearances()
        self.searched = Searched.nothing()
        self.measured = self._features(0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
        self.bad_frames = 0
        self._given: np.ndarray | None = None
        self._in_view = np.zeros((0, 2))
        self.recognised = False
        """Whether the prediction of a lost camera is a place that was recognised beyond doubt."""
        self.seconds = 0.0
        """Time of the last search."""
        self.seconds_choosing = 0.0
        """Part of it that went into the choice of what to look for: all that grows with the map."""

    @property
    def lost(self) -> bool:
        """Whether the camera is not where the filter believes."""
        return self.bad_frames >= self.config.lost_frames

    def begin(self, image: np.ndarray, known_px: np.ndarray, as_group: bool) -> None:
        """Takes the known points from the first image, where they are at known_px (M, 2).

        Args:
            image: the first one.
            known_px: (M, 2).
            as_group: whether they are one landmark, a constellation, or landmarks of their own.

        Raises:
            InputError: one is too near to the border.
        """
        members = np.arange(known_px.shape[0]) if as_group else None
        padded = np.pad(image, SOURCE_HALF_PX + 1, mode="edge")  # a known point may lie at the border
        source = np.array([self._window(padded, px + SOURCE_HALF_PX + 1.0) for px in known_px])
        self.table.add(source, known_px, SE3.identity(), members)
        self._given = known_px

    def observe(self, frame: ImageFrame, belief: Belief) -> Sequence[Observations]:
        """What is found of the features that should be seen."""
        started = time.perf_counter()
        rows, px = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        self.searched = Searched.nothing()
        if self._given is not None:
            rows, px, self._given = np.arange(self._given.shape[0]), self._given, None
        elif self.table.alive.any():
            if frame.image is not None:
                self.searched = self._search(frame.image, belief)
                rows, px = self._agreeing(belief)
            self.bad_frames = self.bad_frames + 1 if self._fails() else 0
            if self.bad_frames:
                rows, px = rows[:0], px[:0]
        self.measured = self._features(frame.stamp_ns, rows, px)
        self.seconds = time.perf_counter() - started
        return self.features.observe(self.measured, belief)

    def births(self, frame: ImageFrame, belief: Belief, observed: Sequence[Observations]) -> Sequence[Births]:
        """Notes what was found, drops what fails, and starts features at corners where there is room."""
        failing = self._judge()
        self._place(belief, self.measured.landmarks)
        sightings = self.measured
        if frame.image is not None and not self.bad_frames:
            sightings = self._with_corners(frame, belief, observed)
        births = self.features.births(sightings, belief, observed)
        self.features.forget(belief, failing)
        return births

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return self.table.arrays() | {"search/bad_frames": np.array(self.bad_frames)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self.table.restore(arrays)
        self.bad_frames = int(arrays["search/bad_frames"])
        self._given = None

    def _search(self, image: np.ndarray, belief: Belief) -> Searched:
        pose = belief.state[belief.mode][:7]
        started = time.perf_counter()
        rows = self._choose(pose)
        self.seconds_choosing = time.perf_counter() - started
        if not rows.size:
            return Searched.nothing()
        rows, mean, cov = self._predict(rows, belief)
        cov = cov + self.config.noise_px**2 * np.eye(2)
        turn = affines(self.camera, self.table.place[rows], self.table.first_pose[rows], pose)
        templates = warp(self.table.source[rows], turn, self.config.template_px)
        matches = search(
            image, templates, mean, cov, sigmas=self.config.sigmas, most_px=self.config.largest_px
        )
        found = (matches.score >= self.config.accept) & self.camera.inside(matches.px)
        return Searched(rows, mean, cov, matches.px, matches.score, found)

    def _agreeing(self, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
        """The found features that agree with one motion of the camera; the others count as not found."""
        searched = self.searched
        hits = np.flatnonzero(searched.found)
        if not hits.size:
            return searched.rows[hits], searched.px[hits]
        rows, px = searched.rows[hits], searched.px[hits]
        which, nu, jac, cov = self.features.innovations(belief, rows, self.table.member[rows], px)
        factor = belief.prior.spread(belief.prior.mean)
        own = factor[belief.mode if factor.shape[0] > 1 else 0]
        cov = cov + self.config.noise_px**2 * np.eye(2)
        good = which[agreeing(nu, jac, cov, own, self.config.gate)]
        searched.found[:] = False
        searched.found[hits[good]] = True
        return rows[good], px[good]

    def _choose(self, pose: np.ndarray) -> np.ndarray:
        """Rows of the features worth looking for, spread over the image (E06 §4.1)."""
        table = self.table
        rows = np.flatnonzero(table.alive)
        seen = directions(table.place[rows], pose)
        # Most of a large map is out of view: all else is asked of the rest alone.
        visible = seen[:, 2] > 0.0
        visible[visible] = self.camera.visible(seen[visible], self.config.margin_px)
        rows, seen = rows[visible], seen[visible]
        cosine, scale = view_changes(table.place[rows], table.first_pose[rows], pose)
        wanted = (scale <= self.config.scale) & (scale >= 1.0 / self.config.scale)
        wanted &= cosine >= np.cos(np.deg2rad(self.config.turn_deg))
        rows, px = rows[wanted], self.camera.project(seen[wanted])
        size = np.array([self.camera.width, self.camera.height])
        column, line = np.clip(px * _CELLS / size, 0, _CELLS - 1).astype(np.int64).T
        cell = column + _CELLS * line
        self._in_view = px
        worth = (table.found[rows] + 1.0) / (table.attempts[rows] + 2.0) - 0.2 * table.missed[rows]
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

    def _fails(self) -> bool:
        """Whether so little agrees that it may be chance. Once lost, more has to agree: the camera may be anywhere.

        Only features whose whole ellipse was searched tell something then: in a larger one something alike is found by
        chance, or what is there is missed. Of a place that was recognised beyond doubt it is enough that it can be
        tracked: patches look different from there.
        """
        found, config = self.searched.found, self.config
        if not found.size:
            return True
        if not self.lost:
            return bool(found.mean() < config.lost_share)
        least = min(config.regained, int(self.table.alive.sum()))
        reach = config.sigmas * np.sqrt(np.einsum("kii->ki", self.searched.cov).max(axis=1))
        found = found[reach <= config.largest_px]
        share = config.lost_share if self.recognised else config.regained_share
        return bool(found.sum() < max(least, share * found.size))

    def _judge(self) -> np.ndarray:
        """Counts hits and misses; rows of what is missed too often."""
        searched, config, table = self.searched, self.config, self.table
        nothing = np.zeros(0, dtype=np.int64)
        if not searched.rows.size or self.bad_frames:
            return nothing
        table.note(searched.rows, searched.found)
        rows = searched.rows
        failing = 1.0 - table.found[rows] / table.attempts[rows] > config.failure_ratio
        drop = rows[failing & (table.attempts[rows] >= config.trial)]
        table.alive[drop] = False
        return np.asarray(drop[table.member[drop] < 0])

    def _place(self, belief: Belief, rows: np.ndarray) -> None:
        """Remembers where in the mode's world features are now."""
        if rows.size:
            chosen, place = self.features.places(belief, rows, self.table.member[rows])
            self.table.place[rows[chosen]] = place

    def _with_corners(
        self, frame: ImageFrame, belief: Belief, observed: Sequence[Observations]
    ) -> FeatureFrame:
        assert frame.image is not None
        config, measured = self.config, self.measured
        room = config.measurements - measured.landmarks.size
        if self.table.count > measured.landmarks.size:
            room = min(config.in_view - self._in_view.shape[0], config.new_per_frame)
        if room <= 0:
            return measured
        occupied = np.concatenate([measured.z, self._in_view])
        px, _ = corners(frame.image, occupied, room, config.spacing_px, SOURCE_HALF_PX + 1.0)
        px = px[np.isfinite(self.camera.unproject(px)).all(axis=1)]
        if not px.shape[0]:
            return measured
        source = np.array([self._window(frame.image, place) for place in px])
        pose = belief.state[belief.mode][:7]
        rows = self.table.add(source, px, pose)
        self.table.place[rows] = self.features.first_places(pose, px, self.features.new_ray(belief, observed))
        return self._features(
            frame.stamp_ns, np.append(measured.landmarks, rows), np.concatenate([measured.z, px])
        )

    def _features(self, stamp_ns: int, rows: np.ndarray, px: np.ndarray) -> FeatureFrame:
        cov = np.repeat(self.config.noise_px**2 * np.eye(2)[None], rows.size, axis=0)
        return FeatureFrame(stamp_ns, rows, px, cov)

    def _window(self, image: np.ndarray, px: np.ndarray) -> np.ndarray:
        window = cut(image, px, SOURCE_HALF_PX)
        if window is None:
            raise InputError(
                f"a known point at ({px[0]:.1f}, {px[1]:.1f}) px is nearer than {SOURCE_HALF_PX} px to the border"
            )
        return window
