"""Initialisation without known points: batch adjustment of the first frames, from which particles are resampled.

Before the camera has moved, depth is unobservable, and for a nearly flat scene two shapes with two motions fit. Particles
decide too early: each image has little information, those that happen to fit it survive, and later images come too late. All
first images together determine it well. So while depths are unknown, the frames so far are adjusted in batch from time to
time ({py:mod}`rbpf.systems.mono.start.adjustment`), whole paths are drawn from the Gaussian at the minimum, or at both if two
are plausible, and each particle's map is conditioned on its path (a block move: A. Doucet, M. Briers and S. Sénécal, 2006).
Once a single one remains and depths are known to some percent, a joint map replaces the particles, if configured.
"""

from collections.abc import Callable, Sequence
from typing import ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, integers, numbers, truths
from rbpf.core.filter import Filter
from rbpf.core.models import Sensor
from rbpf.core.particles import Prior, mixture_estimate, uniform_log_weights
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.start.adjustment import Adjusted, FirstFrames, between, gathered, minima
from rbpf.systems.system import Revision

WELL_KNOWN = 3.0  #: Factor on `depth_std_ratio` that suffices once a later adjustment does not improve depths.
#: Warning if a start without known points ends before depths are known.
DISCONNECTED = (
    "the first frames have too few features in common to be adjusted in one piece: path and map may be bent; move the "
    "camera sideways at first, or start with known points"
)


@final
class UnknownStart(Kept):
    """Adjusts the first frames when it is due, and resamples the particles.

    `new_filter` creates a filter without a past for a sensor, here `features`; `needed`: the run starts without known points
    and without a map.
    """

    kept: ClassVar = {
        "over": truths(),
        "_next": integers(least=0),
        "_ratio": numbers(values="any"),
        "_is_open": truths(),
    }
    prefix = "start/"

    def __init__(
        self,
        config: MonoConfig,
        features: FeatureSensor,
        first: FirstFrames,
        new_filter: Callable[[Sensor], Filter],
        needed: bool,
    ) -> None:
        self.config, self.features, self.first, self.new_filter = config, features, first, new_filter
        #: Whether depths are known well enough, so that the filter continues without adjustments.
        self.over = not (needed and config.start.batch_adjust)
        self._next = config.start.first_adjustment
        self._is_open = False  # whether the last adjustment left two solutions
        self._ratio = np.inf  # relative standard deviation of depths in the last adjustment

    def after_frame(
        self, filter_: Filter, usable: bool, lost: bool, become: Callable[[Filter, bool], Adjusted | None] | None
    ) -> tuple[Adjusted | None, str | None]:
        """Adjusts all frames so far if it is due.

        Args:
            filter_: after its step; a new one gets its sensors and random generator.
            usable: whether the frame may be the last of an adjustment.
            lost: whether the camera is lost: then no further adjustments are made.
            become: creates a joint map from all frames so far, told whether to try the reversed shape, too; None if there is
                to be none, or it is not restarted.

        Returns:
            The resampled particles, or the filter on a joint map, None to continue unchanged; and a message, or None.
        """
        first, count, is_joint = self.first, len(self.first.seen), filter_.consolidation is not None
        self.over = self.over or lost or (is_joint and become is None)
        if self.over or count < self._next or not usable:
            return None, None
        self._next = self.config.start.next_after(count)
        found = gathered(first, self.features, filter_.belief(), self.config.start.max_frames)
        if found is None:
            return None, None
        steps, names, seen, guess = found
        # While depths are unknown, the depth-reversed solution may be another minimum of similar cost.
        start, before, known = self.config.start, self._ratio, WELL_KNOWN * self.config.start.depth_std_ratio
        reverse = before >= known or self._is_open
        shapes = minima(seen, self.config, guess, reverse) if seen.is_connected() else []
        if not shapes:
            self.over = True
            return None, None if is_joint else DISCONNECTED
        # The ambiguity is resolved once the more probable solution also has the lower cost: weights depend on the noise.
        lowest = min(shapes, key=lambda shape: shape.cost)
        weights = np.exp([shape.log_weight - shapes[0].log_weight for shape in shapes])
        shares = np.diff(np.rint(filter_.n * np.cumsum(weights) / weights.sum()).astype(int), prepend=0).tolist()
        self._is_open = count < start.max_frames and (shares[0] < filter_.n or lowest is not shapes[0])
        best = shapes[0] if self._is_open else lowest
        self._ratio = best.depth_std_ratio(np.isin(names, first.seen[-1].landmarks))
        is_known = self._ratio < start.depth_std_ratio
        self.over = not self._is_open and (is_known or (count >= start.max_frames and before <= self._ratio < known))

        # Well-known depths are better represented by one Gaussian; the joint map is restarted until the start is over.
        if become is not None and (is_joint or (self._ratio < known and not self._is_open)):
            return become(filter_, reverse), None

        # Draw whole paths from the Gaussians at the minima, by their weights, and run a filter along them.
        stamps = np.array(first.stamps_ns)
        parts = zip(shapes, shares, strict=True) if self._is_open else [(best, filter_.n)]
        drawn = [shape.paths(share, filter_.rng) for shape, share in parts if share]
        paths = between(stamps[steps], np.concatenate(drawn), stamps)
        filter_ = self._along(paths, set(steps.tolist()), filter_, first.seen)
        equal = uniform_log_weights(paths.shape[1])
        means = [mixture_estimate(Prior.exactly(SE3, poses), None, equal) for poses in paths]
        poses, covs = np.array([each.mean for each in means]), np.array([each.cov for each in means])
        first.path, first.last = list(poses), poses[-1]
        if self._is_open:  # the mean of two solutions is meaningless
            first.path = list(between(stamps[steps], best.structure.path[None], stamps)[:, 0])
        seen_first = first.seen_first(paths[:, filter_.belief().mode])
        return Adjusted(filter_, Revision(stamps, poses, covs), seen_first), None

    def _along(self, paths: np.ndarray, steps: set[int], old: Filter, frames: Sequence[FeatureFrame]) -> Filter:
        """A filter run along paths (T, N, 7), with the observations of the frames from which they were drawn."""
        new = self.new_filter(self.features)
        new.rng, new.log_evidence = old.rng, old.log_evidence
        at_rest = PosePrior(SE3.identity(), np.zeros((6, 6)), self.config.velocity.start_std())
        first = min(steps)
        for t, frame in enumerate(frames):
            state = paths[t]
            before, then = new.particles.state, new.stamp_ns
            if before.shape[1] > 7:  # the velocity is sampled: set it to the path's
                seconds = 0.0 if then is None else (frame.stamp_ns - then) * 1e-9
                moved = before[:, 7:]
                if seconds > 0.0:
                    moved = SE3.log(SE3.between(before[:, :7], state)) / seconds
                state = np.concatenate([state, moved], axis=1)
            if t not in steps:
                frame = frame.take(slice(0))
            new.follow(state, frame, at_rest if t <= first else None, frame.stamp_ns)
        landmark_map = new.belief().map
        landmark_map.remove(landmark_map.ids[~old.belief().map.holds(landmark_map.ids)])
        new.sensors = old.sensors
        return new
