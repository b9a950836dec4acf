"""What tests read off a simulated `FeatureLog`."""

from dataclasses import dataclass

import numpy as np

from examples.studies.point_worlds import Scene
from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureLog


def truth(log: FeatureLog, frame: int) -> np.ndarray:
    """True places (K, 3), in the camera's frame, of what a frame measures."""
    assert log.truth is not None
    world = [log.truth.landmarks[name] for name in log.frames[frame].landmarks.tolist()]
    return SE3.inverse_transform(log.truth.world_from_camera[frame], np.array(world).reshape(-1, 3))


def errors(log: FeatureLog) -> np.ndarray:
    """(n, p) measured minus projected pixels."""
    return np.concatenate([f.z - log.camera.project(truth(log, t)) for t, f in enumerate(log.frames)])


def sightings(log: FeatureLog) -> dict[int, list[int]]:
    """Frames in which each landmark was measured."""
    seen: dict[int, list[int]] = {}
    for t, frame in enumerate(log.frames):
        for name in frame.landmarks.tolist():
            seen.setdefault(name, []).append(t)
    return seen


def likely(successes: float, trials: int, probability: float) -> bool:
    """Within four standard deviations of a binomial distribution."""
    return abs(successes - trials * probability) < 4.0 * np.sqrt(trials * probability * (1.0 - probability))


@dataclass(frozen=True)
class StillCamera:
    """A world of points in view of a camera at rest."""

    frames: int = 10
    points: int = 20

    def build(self, rng: np.random.Generator) -> Scene:
        depth = rng.uniform(1.0, 6.0, (self.points, 1))
        points = depth * np.concatenate([rng.uniform(-0.45, 0.45, (self.points, 2)), np.ones_like(depth)], axis=1)
        present = np.tile([0, self.frames], (self.points, 1))
        stamps = np.arange(self.frames) * 10**8
        path = SE3.identity((self.frames,))
        return Scene("still camera", stamps, path, points, present, np.zeros((0, 2, 3)))
