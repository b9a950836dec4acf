"""The batch adjustment of camera features: what is done without a path, and with too few measurements."""

import re
from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureFrame, KnownPoints
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.validation.gtsam.camera import locate, solve_features
from rbpf.validation.gtsam.observations import ObservationTable
from tests.validation.camera_scenes import BENT, PLAIN, STEREO, WHOLE, scene

pytestmark = pytest.mark.slow

SQUARE = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.3, 0.0], [0.0, 0.3, 0.0]])


def true_start(log):
    return InitialEstimate(log.truth.poses, {})


def at_rest(log):
    """An estimate that says nothing."""
    return InitialEstimate(np.tile(SE3.identity(), (len(log.frames), 1)), {})


def shown(log, step, names, z):
    """The log with another sighting in a frame."""
    frame = log.frames[step]
    cov = np.broadcast_to(np.eye(log.camera.dim), (len(names), log.camera.dim, log.camera.dim))
    more = FeatureFrame(
        frame.stamp_ns,
        np.concatenate([frame.landmarks, names]),
        np.concatenate([frame.z, z]),
        np.concatenate([frame.cov_z, cov]),
    )
    return replace(log, frames=[*log.frames[:step], more, *log.frames[step + 1 :]])


@pytest.mark.parametrize("camera", [BENT, WHOLE, STEREO])
def test_the_same_optimum_is_found_from_known_points_alone(camera):
    log = scene(camera, frames=12, points=25, noise_px=0.5)
    found = solve_features(log, at_rest(log), from_known=True, marginals=False)
    expected = solve_features(log, true_start(log), marginals=False)
    assert found.error == pytest.approx(expected.error, rel=1e-6)
    assert np.abs(SE3.local(expected.world_from_body, found.world_from_body)).max() < 1e-4


@pytest.mark.parametrize(("known", "outliers"), [(4, 0.0), (6, 0.1)])
def test_a_camera_that_rests_at_first_is_followed(known, outliers):
    measuring = Measuring(known=known, outlier_rate=outliers)
    log = simulate_features(DeskWorld(frames=90), measuring, MONO, seed=1)
    robust = 1.345 if outliers else None
    found = solve_features(log, at_rest(log), from_known=True, robust=robust, marginals=False)
    errors = np.sqrt(np.square(SE3.local(log.truth.poses, found.world_from_body)).mean(0))
    assert errors.max() < 0.015


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.0, 3.0])
def test_a_camera_is_located_from_four_points_of_a_plane(turn):
    rng = np.random.default_rng(int(turn))
    for side in rng.normal(scale=0.4, size=(4, 2)):
        away = SE3.exp(np.array([*side, turn, 0.0, 0.0, 0.0]))
        pose = SE3.compose(away, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -0.8]))
        z = PLAIN.project(SE3.inverse_transform(pose, SQUARE)) + 0.1 * rng.normal(size=(4, 2))
        places = np.arange(4)
        table = ObservationTable(PLAIN, np.zeros(4, dtype=int), places, places, z, np.tile(0.01 * np.eye(2), (4, 1, 1)))
        assert np.abs(SE3.local(pose, locate(table, SQUARE))).max() < 0.02
    assert locate(table.rows(places < 3), SQUARE[:3]) is None


def test_a_landmark_that_an_outlier_draws_into_its_camera_is_left_out():
    log = simulate_features(DeskWorld(frames=40), Measuring(known=6, outlier_rate=0.1), MONO, seed=0)
    found = solve_features(log, true_start(log), robust=1.345, marginals=False)
    names, counts = np.unique(np.concatenate([frame.landmarks for frame in log.frames]), return_counts=True)
    left_out = set(names[counts > 1].tolist()) - set(found.landmarks)
    assert left_out
    assert left_out <= set(found.undetermined)
    assert np.abs(SE3.local(log.truth.poses, found.world_from_body)).max() < 0.03


def test_a_stereo_pair_places_a_landmark_seen_once():
    log = scene(STEREO)
    point = np.array([0.3, -0.1, 2.5])
    once = shown(log, 2, np.array([7]), STEREO.project(point)[None])
    found = solve_features(once, true_start(log))
    assert found.undetermined == []
    np.testing.assert_allclose(SE3.inverse_transform(found.world_from_body[2], found.landmarks[7]), point, atol=1e-6)


def test_a_star_keeps_its_direction_and_helps_the_rotation():
    log = scene(noise_px=0.3)
    path = log.truth.poses
    stars = np.array([[0.2, 0.3, 1.0], [-0.5, -0.2, 1.0]])
    starry = log
    for step in range(len(path)):
        turned = np.einsum("ij,kj->ki", (SE3.rotation(path[step]).T @ SE3.rotation(path[2])), stars)
        starry = shown(starry, step, np.array([7, 8]), PLAIN.project(turned))
    found, without = (solve_features(one, true_start(log)) for one in (starry, log))
    assert found.undetermined == [7, 8]
    for name, star in zip((7, 8), stars, strict=True):
        seen = SE3.inverse_transform(found.world_from_body[2], found.landmarks[name])
        assert seen[2] > 0
        np.testing.assert_allclose(PLAIN.project(seen), PLAIN.project(star), atol=1.5)
    for one, other in zip(found.cov_poses[1:], without.cov_poses[1:], strict=True):
        assert np.trace(one[:3, :3]) < np.trace(other[:3, :3])


def test_known_points_that_do_not_hold_the_world_are_refused():
    with pytest.raises(InputError, match="sees 2 known points, expected 3 or more, or none at all"):
        solve_features(scene(known=2), true_start(scene(known=2)))
    log = scene()
    line = log.known.positions[0] + np.outer(np.arange(4.0), [0.1, 0.2, 0.3])
    with pytest.raises(InputError, match="lie on a line; add one beside it"):
        solve_features(replace(log, known=KnownPoints(log.known.names, line, log.known.cov)), true_start(log))


def test_singular_noise_is_refused():
    log = scene()
    cov = log.known.cov.copy()
    cov[1] = np.diag([1e-4, 1e-4, 0.0])
    flat = replace(log, known=KnownPoints(log.known.names, log.known.positions, cov))
    with pytest.raises(InputError, match=f"covariance of known point {log.known.names[1]} is singular"):
        solve_features(flat, true_start(log))
    cov_z = log.frames[1].cov_z.copy()
    cov_z[2] = np.diag([1.0, 0.0])
    frames = [log.frames[0], replace(log.frames[1], cov_z=cov_z), *log.frames[2:]]
    with pytest.raises(InputError, match=f"landmark {log.frames[1].landmarks[2]} in frame 1 of small scene is not"):
        solve_features(replace(log, frames=frames), true_start(log))


def few_landmarks(log):
    frame = log.frames[3]
    few = replace(frame, landmarks=frame.landmarks[:2], z=frame.z[:2], cov_z=frame.cov_z[:2])
    return replace(log, frames=[*log.frames[:3], few, *log.frames[4:]])


def frames_apart(log):
    return replace(
        log, frames=[replace(f, landmarks=f.landmarks + 1000 * (step > 2)) for step, f in enumerate(log.frames)]
    )


@pytest.mark.parametrize(
    ("spoil", "known", "words"),
    [
        (few_landmarks, 4, "Frame 3 of small scene sees 2 landmarks"),
        (frames_apart, 4, "Frame 3 of small scene shares no landmark with the known points"),
        (frames_apart, 0, "Frame 3 of small scene shares no landmark with frame 0"),
    ],
)
def test_frames_that_nothing_holds_are_refused(spoil, known, words):
    log = scene(known=known)
    with pytest.raises(InputError, match=words):
        solve_features(spoil(log), true_start(log))


def test_an_unusable_estimate_is_refused():
    log = scene(known=0)
    path, points = log.truth.poses, log.truth.landmarks
    with pytest.raises(InputError, match=re.escape("poses (6, 7), one for each frame of small scene, found (3, 7)")):
        solve_features(log, InitialEstimate(path[:3], points))
    with pytest.raises(InputError, match="All initial poses of small scene are at one place"):
        solve_features(log, InitialEstimate(np.tile(path[:1], (6, 1)), points))
    turned = path.copy()
    turned[3] = SE3.retract(path[3], np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"Landmark \d+ lies behind the camera in frame \d of small scene"):
        solve_features(log, InitialEstimate(turned, points))
