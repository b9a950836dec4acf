"""One camera whose first frames become a joint map: nothing is lost by it, and it stays honest."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, RoomWorld, simulate_features
from rbpf.core.linearisation import numeric_jacobians
from rbpf.core.models import Part
from rbpf.core.particles import Estimate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_features
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, CameraRay
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.readers.formats import open_images
from rbpf.sensors.readers.known_points import read_known_points
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig, SearchConfig, StartConfig, VelocityConfig
from rbpf.systems.mono.place_recognition import RISK, WRONG, log_likelihood, log_odds
from rbpf.systems.mono.relocalisation import CORNER_PX
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.mono.start.adjustment import FirstFrames
from rbpf.systems.system import TrackingState
from rbpf.validation.simulation.desk_and_room import TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.systems.mono_logs import desk, errors, nees, off, without_known
from tests.systems.plane_sequences import CAMERA, Pictures, known_points, sequence, texture

JOINT = MonoConfig(map="joint", settled_frames=4, start=StartConfig(depth_std_ratio=0.03))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("ratio", [1.0, 1e-12], ids=["points", "rays"])
def test_the_joint_map_is_the_gaussian_about_the_optimum(known, ratio):
    """Its mean moves with the optimum, from which numeric derivatives; its covariance is what that makes of an error."""
    log = desk(3, frames=12, measurements=20)
    config = replace(JOINT, settled_frames=100, calibrate="online" if known else "off")
    slam = filter_features(log if known else without_known(log), config).system
    hand_over = slam.hand_over
    names, seen, best = hand_over._adjusted(slam.filter, slam.features)
    hand_over.config = replace(config, inverse_depth=InverseDepthConfig(promote_std_ratio=ratio))

    def begun(structure, information):
        new = hand_over._use(
            hand_over._new_filter(hand_over._rays, slam.sensor, slam.filter.rng), hand_over._rays, slam.sensor
        )
        revision = hand_over._begin(new, names, seen, replace(best, structure=structure, information=information))
        np.testing.assert_allclose(revision.poses[-1], new.belief().map.origin, atol=1e-12)
        return new.belief().map

    # cov = s sᵀ + η, by which all is known well enough for a point, or for none.
    step = 1e-4 * np.random.default_rng(0).normal(size=len(best.information))
    least, size = 1e-9 * step @ step, step.size
    information = (np.eye(size) - np.outer(step, step) / (least + step @ step)) / least
    one, here, other = (begun(best.structure.moved(sign * step), information) for sign in (-1.0, 0.0, 1.0))
    moved = (other.mean - one.mean)[0] / 2.0
    moved[:6] = SE3.local(one.origin, other.origin) / 2.0
    is_ray = here.are(here.ids, hand_over._rays.landmark)
    assert is_ray.sum() == (0 if ratio == 1.0 else here.ids.size - 4 * known) and here.ids.size > 15
    found = here.cov[: moved.size, : moved.size].copy()
    found[6:12, 6:12] -= np.diag(config.velocity.walk_std() ** 2) * 0.1 / 3.0  # the walk since the last frame
    std = np.sqrt(np.square(moved) + 1e-6 * step @ step)
    np.testing.assert_allclose(found / np.outer(std, std), np.outer(moved / std, moved / std), atol=0.01)


def test_the_longer_ago_the_fewer_frames_are_kept():
    first = FirstFrames()
    for t in range(200):
        first.note(FeatureFrame(t, np.array([t // 50]), np.zeros((1, 2)), np.eye(2)[None]), SE3.identity())
        first.thin(40)
    kept = [frame.stamp_ns for frame in first.seen]
    assert len(kept) == 40 and kept[0] == 0 and kept[-10:] == list(range(190, 200)) and len(first.stamps_ns) == 200
    assert (np.diff(kept) <= 1 + (200 - np.array(kept[:-1])) / 6).all()  # 40 that lie further apart the longer ago
    names, poses = first.seen_first(np.arange(200.0)[:, None] * np.ones(7))
    np.testing.assert_array_equal(names, range(4))
    assert poses[0, 0] == 0.0 and (np.diff(poses[:, 0]) >= 40).all()


@pytest.mark.slow
def test_it_is_honest_where_the_baseline_was_hardly_known():
    """Recordings that a joint map from the first frame on gets wrong by decimetres."""
    scores, off = [], []
    for seed in (100, 103, 104):
        log = simulate_features(DeskWorld(frames=120), Measuring(), MONO, seed)
        run = filter_features(log, MonoConfig(map="joint", seed=seed))
        assert run.system.joint is not None
        scores.append(nees(run).mean() / 6.0)
        off.append(np.linalg.norm(errors(run)[60:, 3:], axis=1).mean())
    assert 0.5 < np.mean(scores) < 2.0 and max(off) < 0.03


@pytest.mark.slow
def test_known_points_tell_two_motions_apart(tmp_path):
    """A room whose parallax a turn explains nearly as well: particles with maps of their own took it, 90 mm off."""
    camera = Pinhole(320, 240, 256.0, 256.0, 159.5, 119.5)
    simulate_images(TexturedRoom(frames=60), Imaging(), camera, tmp_path / "room", seed=5)
    images, known = open_images(tmp_path / "room"), read_known_points(tmp_path / "room" / "known_points.csv")
    slam = MonoSlam(camera, MonoConfig(), known)
    frames = [slam.take(frame) for frame in images.frames()]
    off = [SE3.translation(frame.pose) - pose[4:] for frame, pose in zip(frames, images.truth.poses, strict=True)]
    assert any(frame.revision is not None for frame in frames[:40])
    assert np.linalg.norm(off[40:], axis=1).max() < 0.03


@pytest.mark.parametrize("known", [True, False])
def test_noise_that_is_larger_than_stated_is_learnt(known):
    """Pixels with twice the noise that they say: the hand-over sees it already, and its Gaussian has it."""
    log = desk(1, frames=40, measurements=20, noise_px=2.0)
    log = replace(log, frames=[replace(frame, cov_z=frame.cov_z / 4.0) for frame in log.frames])
    factors, scores = [], []
    for noise in ("stated", "at_least", "learnt"):
        run = filter_features(log if known else without_known(log), replace(JOINT, noise=noise))
        assert run.system.joint is not None
        factors.append(run.system.summary(run.log)["noise_factor"])
        scores.append(np.mean([np.trace(np.linalg.inv(cov)) for cov in run.log.covs[-10:]]))
        told = run.system.measurements("", run.log).frames[-1].cov_z
        np.testing.assert_allclose(told, factors[-1] ** 2 * log.frames[-1].cov_z)
    assert factors[0] == 1.0
    np.testing.assert_allclose(factors[1:], 2.0, rtol=0.12)
    assert scores[1] < 0.5 * scores[0]  # a quarter of the information, but for what is no measurement


@pytest.mark.slow
def test_what_slides_does_not_take_the_map_along():
    """Three of twenty features drift by a tenth of what is stated in every frame; all others keep their places to that."""
    off = {"stated": [], "at_least": []}
    for seed in (1, 2):
        log = desk(seed, frames=60, measurements=20, noise_px=0.1)
        often = np.argsort(-np.bincount(np.concatenate([frame.landmarks for frame in log.frames[20:]])))[:3]
        slides = [0.1 * t * np.isin(each.landmarks, often)[:, None] * [1.0, 0.0] for t, each in enumerate(log.frames)]
        frames = [replace(f, z=f.z + slid, cov_z=100.0 * f.cov_z) for f, slid in zip(log.frames, slides, strict=True)]
        for noise, each in off.items():
            run = filter_features(replace(log, frames=frames), replace(JOINT, noise=noise))
            each.append(np.linalg.norm(errors(run)[20:, 3:], axis=1).mean())
    assert sum(off["at_least"]) < 0.65 * sum(off["stated"])


def test_an_attempt_to_begin_leaves_no_noise_to_the_next_one(monkeypatch):
    log = desk(1, frames=16, measurements=20)
    slam = MonoSlam(log.camera, replace(JOINT, settled_frames=100), log.known)
    for frame in log.frames:
        slam.take(frame)
    for times in (3.0, 1.0):
        monkeypatch.setattr("rbpf.systems.mono.joint.residual_px", lambda seen, *_, times=times: times * seen.noise_px)
        assert slam.hand_over._adjusted(slam.filter, slam.features) is not None
        assert slam.hand_over.noise.mean == pytest.approx(times**2)


def test_noise_that_is_smaller_than_stated_is_learnt_where_it_is_asked_for():
    log = desk(1, frames=40, measurements=20, noise_px=0.3)
    log = replace(log, frames=[replace(frame, cov_z=frame.cov_z / 0.09) for frame in log.frames])
    at_least, learnt = (filter_features(log, replace(JOINT, noise=noise)) for noise in ("at_least", "learnt"))
    assert at_least.system.features.noise_factor == 1.0
    assert 0.25 < np.sqrt(learnt.system.features.noise_factor) < 0.6


def test_features_of_old_sub_maps_are_found_again():
    """What is put away is in the map all the time, and is looked for and found as it is in view."""
    slam = MonoSlam(CAMERA, replace(JOINT, particles=20), None)
    gone, held, found = np.arange(6), [], []
    for t, frame in enumerate(sequence(40).frames()):
        if t == 30:
            slam.joint.put_away(gone)
        slam.take(frame)
        if t >= 30:
            held.append(slam.joint.holds(gone).any())
            found.append(slam.sensor.table.found[gone].sum())
        if t == 31:
            assert np.isin(gone, slam.map().ids).all()
    assert not all(held) and held[-1] and found[-1] >= found[0] + gone.size


@pytest.mark.slow
def test_a_loop_closes_on_landmarks_of_old_sub_maps():
    """Once round a room, until the first landmarks are seen again: as good and as sure of itself as one Gaussian of all."""
    log = simulate_features(RoomWorld(frames=220, laps=1.3, points=300), Measuring(), MONO, 0)
    waiting = []

    def note(run, _):
        joint, names = run.system.joint, run.frame.landmarks
        waiting.append(joint is not None and (np.isin(names, joint.old.ids) & ~joint.holds(names)).sum())

    whole, submaps = (filter_features(log, MonoConfig(submap=most), [note]) for most in (3000, 80))
    assert max(waiting) < 3  # three determine a pose, and return in the frame that observes them
    assert len(submaps.system.joint.old.maps) > 2 and submaps.log["points"].max() < whole.log["points"].max() / 2
    off = [np.linalg.norm(errors(run)[:, 3:], axis=1) for run in (whole, submaps)]
    assert off[1][-40:].mean() < 1.5 * off[0][-40:].mean() + 0.01
    assert nees(submaps).mean() < 1.2 * nees(whole).mean()
    mapped = whole.system.map()
    missing = set(mapped.ids[~mapped.is_ray()]) - set(submaps.system.map().ids)
    # Rays that are out of view when a sub-map is left are dropped; one Gaussian of all may know them later.
    assert len(missing) < 3


# Whether a place is one that was seen before is a matter of evidence: where it may be, and how well everything fits.

HERE = SE3.exp(np.array([0.02, 0.05, -0.03, 0.1, 0.05, -0.1]))
COV = 1e-4 * np.eye(3)


def seen(count: int, wrong: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (M, 3) with covariances, and where a camera sees them, the last ones anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (count, 3))
    px = CAMERA.project(SE3.inverse_transform(HERE, points)) + CORNER_PX * rng.normal(size=(count, 2))
    px[count - wrong :] = rng.uniform(0.0, [CAMERA.width, CAMERA.height], (wrong, 2))
    return points, np.tile(COV, (count, 1, 1)), px


def prior(off_m: float, std_m: float = 1.0) -> Estimate:
    return Estimate(
        SE3.compose(HERE, SE3.exp(np.array([0.1, -0.05, 0.1, off_m, 0.0, 0.0]))), np.diag([0.01] * 3 + [std_m**2] * 3)
    )


def test_the_likelihood_is_the_integral_over_the_pose():
    """By importance sampling."""
    (points, cov, px), here = seen(9, 2), prior(0.5, 0.5)
    found, mode = log_likelihood(CAMERA, HERE, points, cov, px, here)
    rng, std = np.random.default_rng(1), np.repeat([0.02, 0.06], 3)
    away = std * rng.standard_normal((100_000, 6))
    poses = SE3.retract(mode, away)
    off = SE3.local(here.mean, poses)
    total = (
        -0.5 * np.square(off / np.sqrt(np.diagonal(here.cov))).sum(axis=1) - 0.5 * np.log(np.diagonal(here.cov)).sum()
    )
    total += 0.5 * np.square(away / std).sum(axis=1) + np.log(std).sum()
    for point, place in zip(points, px, strict=True):
        near = SE3.inverse_transform(poses, np.broadcast_to(point, (len(poses), 3)))
        by_point = CAMERA.jacobian(near) @ np.swapaxes(SE3.rotation(poses), 1, 2)
        spread = by_point @ COV @ np.swapaxes(by_point, 1, 2) + CORNER_PX**2 * np.eye(2)
        miss = place - CAMERA.project(near)
        squared = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(spread), miss)
        density = np.exp(-0.5 * squared) / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
        total += np.log((1.0 - WRONG) * CAMERA.width * CAMERA.height * density + WRONG)
    np.testing.assert_allclose(found, np.logaddexp.reduce(total) - np.log(len(total)), atol=0.2)


@pytest.mark.parametrize("count", [20, 200])
def test_it_is_no_matter_of_counts(count):
    """However many matches fit: a camera 8 m from there, known to a metre, sees a place that looks alike."""
    size, enough = np.array([15.0, 15.0, 3.0]), -np.log(RISK)
    assert log_odds(CAMERA, HERE, *seen(count, count // 2), prior(1.0), size)[0] > enough
    assert log_odds(CAMERA, HERE, *seen(count, count // 2), prior(8.0), size)[0] < -enough
    assert log_odds(CAMERA, HERE, *seen(count, count), prior(1.0), size)[0] < -enough


@pytest.mark.slow
def test_a_lost_camera_is_found_in_an_old_sub_map():
    """It has left the first wall of a gallery when the light goes out, and is back there when it comes on again."""
    away, dark, end = 90, 130, 150
    frames = np.arange(end)
    back = np.maximum(2.4 - 0.055 * (frames - away), 0.2)
    side = np.where(frames < away, 2.4 * np.sin(np.pi / 2 * frames / away) ** 2, back)
    turn = [0.03 * np.sin(0.2 * frames), 0.0 * side, 0.05 * np.sin(0.13 * frames)]
    poses = SE3.retract(SE3.identity(), np.stack([*turn, side, 0.1 * np.sin(0.09 * frames), -0.05 * side], axis=-1))
    search = SearchConfig(measurements=15, min_in_view=20)
    config = MonoConfig(map="joint", particles=30, settled_frames=4, submap=24, search=search)
    slam, held = MonoSlam(CAMERA, config, known_points()), 0
    for frame in Pictures(
        texture(), poses, lambda t, image: np.zeros_like(image) if away <= t < dark else image
    ).frames(0):
        found = slam.take(frame)
        held = max(held, len(slam.joint.old.maps) if slam.joint else 0)
        if found.state == TrackingState.LOST and slam.attempt is not None:
            assert slam.attempt.agreeing < config.relocalisation.min_inliers  # the present sub-map does not know it
    error = SE3.local(found.pose, poses[-1])
    assert found.state == TrackingState.TRACKED and held > 3
    assert np.linalg.norm(error[3:]) < 0.05 and error @ np.linalg.solve(found.cov, error) < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_fast_camera_keeps_its_scale_where_noise_is_stated_too_large(seed):
    """Three quarters of a round in 100 frames, with a tenth of the stated noise: one Gaussian before the start is over."""
    log = simulate_features(RoomWorld(frames=100, laps=0.75, points=400), Measuring(noise_px=0.1), MONO, seed)
    slam, path, begun = MonoSlam(log.camera), [], []
    for frame in log.frames:
        tracked = slam.take(replace(frame, cov_z=100.0 * frame.cov_z))
        path = [*path, tracked.pose] if tracked.revision is None else list(tracked.revision.poses)
        begun += [slam.start.over] if slam.joint is not None else []
    assert not begun[0] and begun[-1] and off(np.array(path), log.truth.poses, log.truth.stamps_ns) < 0.02


@pytest.mark.slow
def test_a_map_that_is_left_behind_keeps_its_scale():
    """Almost once round a room with a dozen features in view: as far off as the optimum of the same pixels (0.2 m) may be."""
    log = simulate_features(RoomWorld(frames=280, laps=0.91, points=3000), Measuring(measurements=12), MONO, 0)
    run = filter_features(log, MonoConfig(submap=60))
    assert np.linalg.norm(errors(run)[-1, 3:]) < 0.5 and nees(run)[200:].mean() < 4.0 * 6.0


@pytest.mark.slow
def test_a_loop_is_closed_from_far_off():
    """Of features with names, once round a room: at once as exact as the map, and as sure as it should be."""
    log = simulate_features(RoomWorld(frames=310, laps=1.0075, points=3000), Measuring(measurements=12), MONO, 4)
    run = filter_features(log, MonoConfig(submap=60))
    off = np.linalg.norm(errors(run)[:, 3:], axis=1)
    assert off[280] > 0.8 and off[290:300].mean() < 0.1 and nees(run)[290:300].mean() < 6.0 * 6.0


# A camera whose focal lengths and distortion are members of the joint map: found while running, and honest about it.

ONLINE = MonoConfig(calibrate="online", particles=30, settled_frames=15)
BENT = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, (-0.2, 0.05, 1e-3, -2e-3, 0.01))
FISHEYE = Pinhole(640, 480, 300.0, 310.0, 320.0, 240.0, (0.02, -0.01, 0.002, 0.001), "equidistant")


@pytest.mark.parametrize("camera", [BENT, FISHEYE], ids=["radial-tangential", "equidistant"])
def test_slopes_by_the_calibration(camera):
    """Of what is seen, of what is started, and that the linear model is the tuned camera's to the second order."""
    rng = np.random.default_rng(0)
    point, state = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (6, 3)), SE3.exp(0.1 * rng.normal(size=6))
    about, tuned = np.zeros(10), np.concatenate([rng.normal(size=6), [0.02, 0.01, 0.01, -0.02]])
    model = CameraPoint(camera, about=about)
    slope = model.jacobians(state, point, None, about).substate
    numeric = numeric_jacobians(model, SE3, state, point, None, np.tile(about, (6, 1)), by=frozenset({Part.SUBSTATE}))
    np.testing.assert_allclose(slope, numeric.substate, atol=1e-4)
    seen = CameraPoint(camera.tuned(tuned[6:])).predict(state, point)
    predicted = model.predict(state, point, None, tuned)
    assert np.abs(predicted - seen).max() < 0.05 * np.abs(seen - model.predict(state, point)).max()
    ray, step = CameraRay(camera, about=about), 1e-6
    for k in range(4):
        one, other = (camera.tuned(sign * step * np.eye(4)[k]).unproject(seen) for sign in (1.0, -1.0))
        np.testing.assert_allclose(ray.new_by_substate(seen)[:, :2, 6 + k], (one - other) / (2 * step), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_a_focal_length_that_is_too_long_is_found(known):
    """By a camera over a desk; it is nearer than it was, by more than chance, and within what is stated."""
    log = desk(3, frames=60, measurements=20)
    log = replace(log if known else without_known(log), camera=MONO.tuned(np.array([0.05, 0.05, 0.0, 0.0])))
    run = filter_features(log, ONLINE)
    camera, std = run.system.hand_over.calibration(run.system.filter)
    assert abs(np.log(camera.fx / MONO.fx)) < min(3.0 * std[0], 0.02) and std[0] < 0.01
    entries = run.system.summary(run.log)["calibration"]
    assert entries["fx"] == camera.fx and entries["std_fx"] == pytest.approx(camera.fx * std[0])
    assert f"fx: {float(camera.fx)!r}" in run.system.files(run.log)["camera.yaml"]
    assert run.system.measurements("desk", run.log).camera == camera


@pytest.mark.parametrize("options", [{"map": "particles"}, {"known": "points"}, {"lag": 5}, {}], ids=repr)
def test_what_is_refused(options):
    refused = replace(ONLINE, **options) if options else replace(JOINT, velocity=VelocityConfig("paper"))
    told = "calibrate=online holds the camera in a joint map" if options else r"set velocity\.mode=marginal, not paper"
    with pytest.raises(InputError, match=told):
        MonoSlam(MONO, refused)
