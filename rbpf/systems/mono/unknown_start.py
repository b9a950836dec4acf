"""A start without known points: the particles are drawn anew from the optimum of the first frames.

Before a camera has moved, nothing tells the depth of what it sees, and of a scene that is nearly flat two shapes with
two motions look alike. Particles decide too early: each image alone tells little, those that happen to fit it survive,
and what later images say comes too late. All first images together tell it well. So while depths are unknown, the
frames until now are adjusted in one piece now and then (`rbpf.systems.mono.start_optimum`), whole paths are drawn from
the Gaussian about the optimum, and each particle's map is that of its path (a block move: A. Doucet, M. Briers and
S. Sénécal, 2006).
"""

from collections.abc import Sequence
from typing import final

import numpy as np

from rbpf.core.archive import checked
from rbpf.core.filter import Filter
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.start_optimum import Expected, Optimum, Structure, Window, optimum
from rbpf.systems.mono.system import assemble, start_std, walk_std

LEAST_SEEN = 3
"""Frames that must see a feature for it to take part."""

LEAST_FRAMES = 3

SHARED = 6
"""Features that two frames in a row must have in common: three determine a pose, and half of them may be wrong."""

TINY = np.finfo(float).tiny

TORN = (
    "the first frames have too few features in common to be adjusted in one piece: path and map may be bent; move the "
    "camera sideways at first, or start with known points"
)
"""Of a start without known points that ended before depths were known."""


@final
class UnknownStart:
    """Says when the particles are to be drawn anew, and draws them.

    Args:
        config: of the run.
        needed: whether the run starts without known points and without a map.
    """

    def __init__(self, config: MonoConfig, needed: bool) -> None:
        self.config = config
        self.over = not (needed and config.start.batch_adjust)
        """Whether depths are known well enough, and the filter goes on alone."""
        self._next = config.start.first_adjustment
        self._last: tuple[np.ndarray, np.ndarray, Structure] | None = None

    def due(self, frames: int, lost: bool) -> bool:
        """Whether the particles are to be drawn anew after so many frames; never again once the camera was lost."""
        self.over = self.over or lost
        return not self.over and frames >= self._next

    def redrawn(
        self, filter_: Filter, features: FeatureSensor, frames: Sequence[FeatureFrame], path: np.ndarray
    ) -> tuple[Filter, np.ndarray] | None:
        """A filter whose particles are drawn anew, in place of one that has just made its T-th step, and their paths.

        Args:
            filter_: the one so far; the new one has its sensors and its random generator.
            features: what it observes with.
            frames: T, all that was measured.
            path: (T, 7) world_from_camera, where the filter was.

        Returns:
            The filter, and (T, N, 7) world_from_camera; None where too little was seen, and the old one goes on.
        """
        self._next = max(int(np.ceil(self.config.start.growth * len(frames))), len(frames) + 1)
        found = self._found(filter_, features, frames, path)
        if found is None:
            return None
        steps, best = found
        stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
        paths = between(stamps[steps], best.paths(self.config.particles, filter_.rng), stamps)
        return self._along(paths, set(steps.tolist()), filter_, features, frames), paths

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        names, steps, structure = self._last or _NOTHING
        return {
            "start/progress": np.array([self.over, self._next]),
            "start/names": names,
            "start/steps": steps,
            "start/path": structure.path,
            "start/direction": structure.direction,
            "start/inverse": structure.inverse,
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`.

        Raises:
            InputError: they are not what they should be.
        """
        over, self._next = checked(arrays, "start/progress", (2,), "i").tolist()
        self.over = bool(over)
        names = checked(arrays, "start/names", (None,), "i")
        steps = checked(arrays, "start/steps", (None,), "i")
        structure = Structure(
            checked(arrays, "start/path", (steps.size, 7), "f"),
            checked(arrays, "start/direction", (names.size, 3), "f"),
            checked(arrays, "start/inverse", (names.size,), "f"),
        )
        self._last = (names, steps, structure) if names.size else None

    def _found(
        self, filter_: Filter, features: FeatureSensor, frames: Sequence[FeatureFrame], path: np.ndarray
    ) -> tuple[np.ndarray, Optimum] | None:
        """Numbers of the frames that took part, and the best optimum; None where too little is seen."""
        steps = self._chosen(frames)
        if steps.size < LEAST_FRAMES:
            return None
        held = np.array(sorted(filter_.belief().catalogue.values()), dtype=np.int64)
        seen_by = np.concatenate([frames[t].landmarks for t in steps])
        names, count = np.unique(seen_by[np.isin(seen_by, held)], return_counts=True)
        names = names[count >= LEAST_SEEN]
        seen = self._window(features, [frames[t] for t in steps], names)
        self.over = not _hang_together(seen)
        if self.over:
            return None
        starts = [self._where_the_filter_is(filter_, features, names, path[steps])]
        ray, velocity = self.config.inverse_depth, self.config.velocity
        rho = ray.mean_per_m, ray.std_per_m
        expected = Expected(rho, start_std(velocity), walk_std(velocity))
        if self._last is not None:
            starts.append(self._gone_on(features, seen, names, path[steps], steps))
        best = min((optimum(seen, expected, start) for start in starts), key=lambda each: each.cost)
        self._last = names, steps, best.structure
        relative = best.std_inverse() / np.maximum(best.structure.inverse, TINY)
        relative = relative[np.isin(names, frames[-1].landmarks)]
        self.over = bool(relative.size and np.median(relative) < self.config.start.depth_std_ratio)
        return steps, best

    def _chosen(self, frames: Sequence[FeatureFrame]) -> np.ndarray:
        """Numbers of frames that see something, with a stamp of their own, the first and the last among them."""
        stamps = np.array([frame.stamp_ns for frame in frames])
        fresh = np.append(True, np.diff(stamps) > 0) & [frame.landmarks.size > 0 for frame in frames]
        steps = np.flatnonzero(fresh)
        most = min(self.config.start.max_frames, steps.size)
        return steps[np.linspace(0, steps.size - 1, most).round().astype(np.int64)]

    def _window(self, features: FeatureSensor, frames: list[FeatureFrame], names: np.ndarray) -> Window:
        taking_part = [np.isin(frame.landmarks, names) for frame in frames]
        return Window(
            features.camera,
            np.array([frame.stamp_ns for frame in frames], dtype=np.int64),
            np.repeat(np.arange(len(frames)), [part.sum() for part in taking_part]),
            np.searchsorted(
                names,
                np.concatenate([f.landmarks[part] for f, part in zip(frames, taking_part, strict=True)]),
            ),
            np.concatenate([f.z[part] for f, part in zip(frames, taking_part, strict=True)]),
            float(np.sqrt(np.mean([np.trace(cov) / 2.0 for f in frames for cov in f.cov_z]))),
        )

    def _where_the_filter_is(
        self, filter_: Filter, features: FeatureSensor, names: np.ndarray, path: np.ndarray
    ) -> Structure:
        """The heaviest particle's map, and the path that was reported."""
        which, place = features.places(filter_.belief(), names, np.full(names.size, -1))
        ordered = np.empty_like(place)
        ordered[which] = place
        return _structure(SE3.between(path[:1], path), ordered)

    def _gone_on(
        self, features: FeatureSensor, seen: Window, names: np.ndarray, path: np.ndarray, steps: np.ndarray
    ) -> Structure:
        """The last adjustment's path and structure, gone on with as the filter moved, and what is new at the prior."""
        assert self._last is not None
        before, old_steps, structure = self._last
        joint = int(np.searchsorted(steps, old_steps[-1], side="right")) - 1
        start = between(old_steps, structure.path[None], steps[: joint + 1])[:, 0]
        onward = SE3.compose(start[-1:], SE3.between(path[joint : joint + 1], path[joint + 1 :]))
        whole = np.concatenate([start, onward])
        place = np.empty((names.size, 4))
        _, first = np.unique(seen.feature, return_index=True)
        # Where the lens has no direction, straight ahead is enough to start from.
        uv = np.nan_to_num(features.camera.unproject(seen.px[first]))
        pose, rho = whole[seen.frame[first]], self.config.inverse_depth.mean_per_m
        ahead = np.concatenate([uv, np.ones((names.size, 1))], axis=1)
        place[:, :3] = SE3.transform(pose, ahead) + (rho - 1.0) * SE3.translation(pose)
        place[:, 3] = rho
        _, now, then = np.intersect1d(names, before, return_indices=True)
        place[now] = np.concatenate([structure.direction, structure.inverse[:, None]], axis=1)[then]
        return _structure(whole, place)

    def _along(
        self,
        paths: np.ndarray,
        steps: set[int],
        old: Filter,
        features: FeatureSensor,
        frames: Sequence[FeatureFrame],
    ) -> Filter:
        """A filter that has followed paths (T, N, 7), measuring in the frames that they were drawn from."""
        new = assemble(self.config, features, None)
        new.rng, new.log_evidence = old.rng, old.log_evidence
        start = min(steps)
        law = PosePrior(SE3.identity(), np.zeros((6, 6)), start_std(self.config.velocity))
        for t, frame in enumerate(frames):
            state = self._state(new, paths[t], frame.stamp_ns)
            measured = frame if t in steps else _unseen(frame)
            new.follow(state, measured, law if t <= start else None, frame.stamp_ns)
        held = set(old.belief().catalogue.values())
        gone = [name for name in new.belief().catalogue.values() if name not in held]
        features.forget(new.belief(), np.array(gone, dtype=np.int64))
        new.sensors = old.sensors
        return new

    def _state(self, filter_: Filter, pose: np.ndarray, stamp_ns: int) -> np.ndarray:
        """The particles' next states (N, E) at poses (N, 7), with the velocity that led there where it is sampled."""
        before, then = filter_.particles.state, filter_.stamp_ns
        if before.shape[1] == 7:
            return pose
        seconds = 0.0 if then is None else (stamp_ns - then) * 1e-9
        moved = SE3.log(SE3.between(before[:, :7], pose)) / seconds if seconds > 0.0 else before[:, 7:]
        return np.concatenate([pose, moved], axis=1)


def _unseen(frame: FeatureFrame) -> FeatureFrame:
    return FeatureFrame(frame.stamp_ns, frame.landmarks[:0], frame.z[:0], frame.cov_z[:0])


def _hang_together(seen: Window) -> bool:
    """Whether each two frames in a row have features in common."""
    sees = np.zeros((seen.stamps_ns.size, seen.feature.max(initial=-1) + 1), dtype=bool)
    sees[seen.frame, seen.feature] = True
    return bool(((sees[1:] & sees[:-1]).sum(axis=1) >= SHARED).all())


def between(times: np.ndarray, paths: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses (W, n, 7) of paths (n, T, 7) at other times (W,): on the way between two, or the first or the last."""
    moved = SE3.log(SE3.between(paths[:, :-1], paths[:, 1:]))
    k = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, times.size - 2)
    fraction = np.clip((wanted - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
    return np.swapaxes(SE3.retract(paths[:, k], fraction[:, None] * moved[:, k]), 0, 1)


def _structure(path: np.ndarray, place: np.ndarray) -> Structure:
    """From homogeneous points (F, 4)."""
    length = np.linalg.norm(place[:, :3], axis=1, keepdims=True)
    return Structure(path, place[:, :3] / length, place[:, 3] / length[:, 0])


_NOTHING = (
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
    Structure(np.zeros((0, 7)), np.zeros((0, 3)), np.zeros(0)),
)
