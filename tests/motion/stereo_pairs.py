"""Simulated matches of two stereo frames, of cameras like KITTI's and like a ZED's."""

from typing import NamedTuple

import numpy as np

from rbpf.lie import SE3
from rbpf.motion.stereo_geometry import Matches
from rbpf.sensors.camera import Pinhole, RectifiedStereo

CAR = RectifiedStereo(Pinhole(1241, 376, 718.0, 718.0, 607.0, 185.0), 0.537)
HAND = RectifiedStereo(Pinhole(672, 376, 350.0, 352.0, 336.0, 188.0), 0.12)


class World(NamedTuple):
    """Where points are seen, and how the camera moves between its two frames."""

    camera: RectifiedStereo
    nearest_m: float
    farthest_m: float
    xi: tuple[float, ...]


ROAD = World(CAR, 5.0, 60.0, (0.003, 0.03, -0.002, 0.02, -0.02, 0.9))
ROOM = World(HAND, 1.0, 6.0, (0.01, 0.05, -0.01, 0.02, 0.005, 0.06))
LEAP = World(HAND, 1.0, 6.0, (0.1, 0.4, -0.1, 0.2, 0.05, 0.3))
FAR_ROAD = World(CAR, 100.0, 1000.0, ROAD.xi)


class Pair(NamedTuple):
    """Matches and the true increment."""

    matches: Matches
    delta: np.ndarray


def noiseless(world: World, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (K, 3) of both frames and the increment (7,); the depths are uniform, the pixels fill the image."""
    camera, delta = world.camera, SE3.exp(np.array(world.xi))
    depth = rng.uniform(world.nearest_m, world.farthest_m, (6 * count, 1))
    px = rng.uniform(0.0, [camera.camera.width, camera.camera.height], (6 * count, 2))
    before = depth * np.concatenate([camera.camera.unproject(px), np.ones_like(depth)], axis=1)
    now = SE3.inverse_transform(delta, before)
    seen = np.flatnonzero(camera.visible(before) & camera.visible(now))[:count]
    assert len(seen) == count
    return camera.project(before[seen]), camera.project(now[seen]), delta


def simulate(world: World, count: int, rng: np.random.Generator, noise_px: float = 0.5) -> Pair:
    """Matches with white noise of one standard deviation."""
    before, now, delta = noiseless(world, count, rng)
    cov = np.tile(noise_px**2 * np.eye(3), (count, 1, 1))
    before, now = (z + noise_px * rng.normal(size=z.shape) for z in (before, now))
    return Pair(Matches(world.camera, before, now, cov, cov), delta)


def correlated(world: World, count: int, rng: np.random.Generator) -> Pair:
    """Matches whose noise is correlated, and another for each."""
    before, now, delta = noiseless(world, count, rng)
    pixels, covs = [], []
    for z in (before, now):
        factor = 0.5 * np.eye(3) + rng.normal(scale=0.15, size=(count, 3, 3))
        pixels.append(z + (factor @ rng.normal(size=(count, 3, 1)))[..., 0])
        covs.append(factor @ factor.mT)
    return Pair(Matches(world.camera, *pixels, *covs), delta)


def mistaken(pair: Pair, fraction: float, rng: np.random.Generator) -> tuple[Matches, np.ndarray]:
    """Some of the later pixels exchanged among one another; which ones, (K,) bool."""
    matches = pair.matches
    wrong = np.flatnonzero(rng.random(len(matches)) < fraction)
    z_now = matches.z_now.copy()
    z_now[wrong] = matches.z_now[np.roll(wrong, 1)] + rng.normal(scale=3.0, size=(len(wrong), 3))
    mask = np.zeros(len(matches), dtype=bool)
    mask[wrong] = True
    return Matches(matches.camera, matches.z_prev, z_now, matches.cov_prev, matches.cov_now), mask


def joined(first: Matches, second: Matches) -> Matches:
    """The matches of both, of one camera."""
    names = "z_prev", "z_now", "cov_prev", "cov_now"
    both = (np.concatenate([getattr(first, name), getattr(second, name)]) for name in names)
    return Matches(first.camera, *both)
