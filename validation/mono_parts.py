"""Perfect parts for a monocular filter: matches and depths that a batch adjustment vouches for."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import final

import numpy as np

from rbpf.core.belief import Belief
from rbpf.core.models import NewLandmarks, Observations, Sensor
from rbpf.lie import SE3
from rbpf.sensors.camera.points import CameraRay
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.validation.gtsam.mono_batch import Batch, adjust_log

WRONG_PX = 3.0
"""A match farther than this from the reprojection by the batch is a wrong one."""

DEPTH_FRACTION = 0.01
"""Standard deviation of a depth that is given, as a fraction of it."""


def reprojection_errors(batch: Batch) -> list[np.ndarray]:
    """Distance of each match from the reprojection of its landmark, by frame (K,), px; NaN without a landmark."""
    camera, points, out = batch.log.camera, batch.solution.landmarks, []
    nowhere = np.full(3, np.nan)
    for frame, pose in zip(batch.log.frames, batch.world_from_camera, strict=True):
        world = np.array([points.get(name, nowhere) for name in frame.landmarks.tolist()]).reshape(-1, 3)
        seen = camera.project(SE3.inverse_transform(pose, world))
        out.append(np.linalg.norm(seen - frame.z, axis=1))
    return out


def agreeing_matches(log: FeatureLog, batch: Batch) -> FeatureLog:
    """The log without the matches that the batch shows to be wrong."""
    frames = list(log.frames)
    for t, error in zip(batch.frames.tolist(), reprojection_errors(batch), strict=True):
        frame, kept = frames[t], ~(error > WRONG_PX)
        frames[t] = FeatureFrame(frame.stamp_ns, frame.landmarks[kept], frame.z[kept], frame.cov_z[kept])
    return replace(log, frames=frames)


def adjust_near(log: FeatureLog, batch: Batch) -> Batch:
    """The optimum of a log that is nearly the batch's, from the batch's."""
    path = np.tile(SE3.identity(), (len(log.frames), 1))
    path[batch.frames] = batch.world_from_camera
    return adjust_log(log, path, twice=False)


def batch_depths(batch: Batch) -> dict[int, float]:
    """Depth of each landmark in the camera that saw it first, by name, m; without those that the batch leaves open."""
    open_ = set(batch.solution.undetermined)
    depths: dict[int, float] = {}
    for frame, pose in zip(batch.log.frames, batch.world_from_camera, strict=True):
        for name in frame.landmarks.tolist():
            if name not in depths and name not in open_ and name in batch.solution.landmarks:
                depth = SE3.inverse_transform(pose, batch.solution.landmarks[name])[2]
                depths[name] = float(depth)
    return {name: depth for name, depth in depths.items() if depth > 0.0}


@final
class GivenDepths(Sensor):
    """A sensor whose landmarks start at depths that are known beforehand.

    Args:
        features: the sensor.
        depths: by name, m; others start as usual.
    """

    def __init__(self, features: FeatureSensor, depths: Mapping[int, float]) -> None:
        self.features, self.depths = features, depths

    def observe(self, frame: FeatureFrame, belief: Belief) -> Sequence[Observations]:
        """As the sensor does."""
        return self.features.observe(frame, belief)

    def new_landmarks(
        self, frame: FeatureFrame, belief: Belief, observed: Sequence[Observations]
    ) -> Sequence[NewLandmarks]:
        """As the sensor does, but each landmark at its own depth."""
        groups = self.features.new_landmarks(frame, belief, observed)
        return [single for group in groups for single in self._singles(group)]

    def _singles(self, group: NewLandmarks) -> list[NewLandmarks]:
        out = []
        for k, name in enumerate(group.facts):
            model = group.model
            if name in self.depths:
                rho = 1.0 / self.depths[name]
                model = CameraRay(self.features.camera, (rho, DEPTH_FRACTION * rho))
            out.append(
                NewLandmarks(group.z[k : k + 1], group.cov[k : k + 1], model, group.landmark, facts=[name])
            )
        return out
