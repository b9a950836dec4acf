"""One update of stereo SLAM: 400 particles, about 60 observations, in a map of 11,000 landmarks and in a small one.

The costs above the base line in S05 Fig. 7: matching with the map, weights, resampling, updates, new landmarks. The large
map surrounds the robot, as after 4,000 frames; part of it is in view. Its landmarks were written in many generations,
and each particle has all of them.
"""

import numpy as np

from benchmarks.rows import Row, Settings, interleaved
from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.stereo import StereoFeatures
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.landmarks import Pair
from rbpf.systems.stereo.slam import StereoSlam

RIG = RectifiedStereo(Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5), 0.12)
LARGE, SMALL, FEATURES, NEW = 11_000, 1_000, 100, 12
NOISE = np.diag([0.1, 0.1, 0.12]) + 0.05 * np.array([[1, 0, 1], [0, 0, 0], [1, 0, 1]])
STD = np.repeat([5e-4, 2e-3], 3)
PLACE_M, KEY = 0.01, 0.012
SETTLING = 8


class Drive:
    """A robot that turns on the spot, surrounded by landmarks."""

    def __init__(self, landmarks: int, turns: int) -> None:
        rng, config = np.random.default_rng(0), StereoConfig.s05()
        self.rng, self.config, self.turn = rng, config, 0
        slam = StereoSlam(RIG, config)
        self.sensor, self.filter = slam.front_end.landmarks, slam.filter
        azimuth, height = rng.uniform(-np.pi, np.pi, landmarks), rng.uniform(-1.0, 1.0, landmarks)
        away = rng.uniform(1.5, 8.0, landmarks)
        self.places = np.stack([away * np.sin(azimuth), height, away * np.cos(azimuth)], axis=1)
        descriptors = np.abs(rng.standard_normal((landmarks, config.sift.length)))
        self.descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
        self._fill(landmarks)
        self.frames = [self._features(turned(turn)) for turn in range(1, turns + SETTLING + 1)]
        for _ in range(SETTLING):
            self()

    def __call__(self) -> None:
        """One update."""
        features = self.frames[self.turn]
        everything = np.ones(len(features), dtype=bool)
        view = Pair(10**9 * self.turn, features, everything, everything, np.zeros(len(features), dtype=np.int8))
        self.filter.step(view, Odometry(turned(1), np.diag(STD**2)))
        self.turn += 1

    def _fill(self, landmarks: int) -> None:
        """Adds every landmark to every particle's map, with counters of one often observed."""
        sensor, n = self.sensor, self.config.particles
        names = sensor.manager.add(self.descriptors)
        table = np.column_stack([names, np.full(landmarks, 5), np.zeros(landmarks, dtype=np.int64)])
        sensor.manager.restore(sensor.manager.arrays() | {"key_manager/table": table})
        sensor.places.add(np.zeros((landmarks, 0, 0), np.uint8), np.zeros((landmarks, 4)))  # no first views
        sensor.places.put(np.arange(landmarks), self.places, SE3.identity())
        held = self.filter.belief().map
        for part in np.array_split(names, max(1, landmarks // 500)):
            mean = self.places[part] + PLACE_M * self.rng.standard_normal((n, part.size, 3))
            cov = np.broadcast_to(PLACE_M**2 * np.eye(3), (n, part.size, 3, 3))
            held.add_records(Records(mean, cov), sensor.landmark, ids=part)

    def _features(self, pose: np.ndarray) -> StereoFeatures:
        """Features of landmarks in view, and of unknown objects."""
        rng, length = self.rng, self.descriptors.shape[1]
        local = SE3.inverse_transform(pose, self.places)
        seen = np.flatnonzero(RIG.visible(local, 5.0))
        seen = rng.permutation(seen)[: FEATURES - NEW - 28]
        fresh = FEATURES - seen.size
        other = np.abs(rng.standard_normal((fresh, length)))
        descriptors = np.concatenate([self.descriptors[seen] + KEY * rng.standard_normal((seen.size, length)), other])
        descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
        spread = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], (fresh, 3))
        z = RIG.project(np.concatenate([local[seen], spread]))
        z += rng.multivariate_normal(np.zeros(3), NOISE, FEATURES)
        zero = np.zeros(FEATURES)
        cov = np.tile(NOISE, (FEATURES, 1, 1))
        return StereoFeatures.measured(RIG, z, cov, zero + 2.0, zero, descriptors)


def turned(times: int) -> np.ndarray:
    """world_from_camera (7,) after a number of updates."""
    return SE3.exp(np.array([0.0, 0.02 * times, 0.0, 0.0, 0.0, 0.0]))


def run(settings: Settings) -> list[Row]:
    """The large map against the small one."""
    turns = settings.repetitions(40)
    contestants = {name: Drive(size, turns + 3) for name, size in (("large", LARGE), ("small", SMALL))}
    times = interleaved(contestants, turns)
    large, small = times["large"].median * 1e3, times["small"].median * 1e3
    seen = int((contestants["large"].sensor.ids >= 0).sum())
    return [
        Row(
            f"stereo update, 400 particles, {LARGE} landmarks",
            large,
            "ms",
            f"with {SMALL} landmarks",
            small,
            small / large,
            notes=f"{seen} landmarks and new ones in the last frame; "
            f"fastest {1e3 * times['large'].seconds.min():.3g} ms, {times['large'].spread}",
        )
    ]
