"""Simulated worlds of points: cameras in a hand, and what is measured: noise, visibility, outliers."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from examples.studies.point_worlds import (
    MONO,
    STEREO,
    DeskWorld,
    LabWorld,
    Measuring,
    PointWorld,
    Scene,
    hidden,
    simulate_features,
)
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureLog
from rbpf.validation.simulation.lab import LabDrive
from rbpf.validation.simulation.paths import looking, slowed


def truth(log: FeatureLog, frame: int) -> np.ndarray:
    """True places (K, 3), in the camera's frame, of what a frame measures."""
    assert log.truth is not None
    world = [log.truth.landmarks[name] for name in log.frames[frame].landmarks.tolist()]
    return SE3.inverse_transform(log.truth.world_from_camera[frame], np.array(world).reshape(-1, 3))


def errors(log: FeatureLog) -> np.ndarray:
    """(n, p) measured minus projected pixels."""
    return np.concatenate([f.z - log.camera.project(truth(log, t)) for t, f in enumerate(log.frames)])


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


CAMERAS = [MONO, STEREO]
FISHEYE = replace(MONO, fx=262.0, fy=262.0, distortion=(-0.03, 0.02, -0.012, 0.002), distortion_model="equidistant")
BENT = replace(MONO, distortion=(-0.28, 0.07, 2e-4, 2e-5, 0.0))
DESK = DeskWorld(frames=200)
STILL = StillCamera(frames=400)
CHANGING = LabWorld(LabDrive(frames=60, every=10), points=3000)


@pytest.mark.parametrize("camera", CAMERAS)
def test_measurements_are_projections_with_the_stated_noise(camera: Pinhole | RectifiedStereo) -> None:
    log = simulate_features(DESK, Measuring(noise_px=0.7), camera, seed=0)
    score = errors(log) / 0.7
    n = score.size
    assert n > 5000
    assert abs((score**2).sum() - n) < 4.0 * np.sqrt(2.0 * n)
    assert (np.abs(score.sum(axis=0)) < 4.0 * np.sqrt(len(score))).all()
    assert abs((score[:, 0] * score[:, 1]).sum()) < 4.0 * np.sqrt(len(score))
    for frame in log.frames:
        np.testing.assert_allclose(frame.cov_z, np.tile(0.49 * np.eye(camera.dim), (len(frame.z), 1, 1)))


@pytest.mark.parametrize(("world", "camera"), [(DESK, MONO), (CHANGING, STEREO), (CHANGING, BENT), (DESK, FISHEYE)])
def test_only_what_is_visible_is_measured(world: PointWorld, camera: Pinhole | RectifiedStereo) -> None:
    measuring = Measuring(nearest_m=0.7, farthest_m=5.0)
    log = simulate_features(world, measuring, camera, seed=1)
    assert len(log.outside()) == 0
    for t in range(len(log.frames)):
        points = truth(log, t)
        assert camera.visible(points, margin_px=8.0).all()
        distance = np.linalg.norm(points, axis=1)
        assert ((distance >= 0.7) & (distance <= 5.0)).all()


@pytest.mark.parametrize("camera", CAMERAS)
def test_share_and_place_of_outliers(camera: Pinhole | RectifiedStereo) -> None:
    log = simulate_features(STILL, Measuring(outlier_rate=0.1), camera, seed=0)
    first = np.zeros(sum(len(frame.z) for frame in log.frames), dtype=bool)
    first[: len(log.frames[0].z)] = True
    wrong = np.abs(errors(log)).max(axis=1) > 6.0
    assert not wrong[first].any()
    assert likely(wrong[~first].sum(), int((~first).sum()), 0.1)
    z = np.concatenate([frame.z for frame in log.frames])[wrong]
    size = np.array([640.0, 480.0])
    assert (np.abs(z[:, :2].mean(axis=0) / size - 0.5) < 4.0 / np.sqrt(12.0 * len(z))).all()
    assert len(log.outside()) == 0
    if camera is STEREO:
        assert (z[:, 2] <= z[:, 0]).all()


def test_known_points_are_given_with_the_stated_error() -> None:
    score, flat = [], []
    for seed in range(20):
        log = simulate_features(DeskWorld(frames=2), Measuring(known=5, known_std_m=0.02), MONO, seed)
        assert log.known is not None and log.truth is not None
        points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
        score.append((log.known.positions - points) / 0.02)
        np.testing.assert_allclose(log.known.cov, np.tile(4e-4 * np.eye(3), (5, 1, 1)))
        px = MONO.project(SE3.inverse_transform(log.truth.world_from_camera[0], points))
        flat.append(np.linalg.svd(px - px.mean(axis=0), compute_uv=False)[1])
    n = np.size(score)
    assert abs(np.sum(np.square(score)) - n) < 4.0 * np.sqrt(2.0 * n)
    assert min(flat) > 100.0


@pytest.mark.parametrize(
    ("world", "measuring", "message"),
    [
        (DeskWorld(points=3), Measuring(), "first frame of the desk sees [0-3] points .* expected 4: simulate more"),
        (DeskWorld(), Measuring(known=30), "30 known points do not fit into 25 measurements"),
    ],
)
def test_refused_worlds(world: PointWorld, measuring: Measuring, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate_features(world, measuring, MONO, seed=0)


def test_a_camera_looks_at_what_it_should() -> None:
    eye, target = np.array([[1.0, -2.0, 0.5]]), np.array([-0.3, 1.0, 0.2])
    pose = looking(eye, target - eye)
    np.testing.assert_allclose(SE3.inverse_transform(pose, target)[0, :2], 0.0, atol=1e-12)
    above = SE3.inverse_transform(pose, target + np.array([0.0, 0.0, 0.1]))[0]
    assert abs(above[0]) < 1e-12 and above[1] < 0.0 < above[2]


@pytest.mark.parametrize(("limits", "pace"), [((0.5, 9.0), 0.25), ((9.0, 0.5), 0.5), ((9.0, 9.0), 1.0)])
def test_a_path_is_slowed_down_and_never_sped_up(limits: tuple[float, float], pace: float) -> None:
    def path(time: np.ndarray) -> np.ndarray:
        return SE3.exp(time[:, None] * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 2.0]))

    seconds = np.linspace(0.0, 2.0, 50)
    np.testing.assert_allclose(slowed(path, seconds, *limits)(seconds), path(pace * seconds), atol=1e-12)


def test_blocks_hide_from_behind_and_show_their_faces() -> None:
    block = np.array([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]])
    eye = np.array([-1.0, 0.5, 0.4])
    behind, before, beside, front, back = ([2, 0.5, 0.5], [-0.1, 0.5, 0.5], [2, 3, 0.5], [0, 0.7, 0.3], [1, 0.7, 0.3])
    points = np.array([behind, before, beside, front, back, [-3.0, 0.5, 0.4]])
    assert hidden(eye, points, block).tolist() == [True, False, False, False, True, False]
