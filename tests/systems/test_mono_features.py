"""Named features through the monocular system: starts, rays and points, equal bytes, what a frame may hold."""

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.studies.point_worlds import STEREO, DeskWorld, Measuring, simulate_features
from rbpf.core.filter import Filter, StepReport
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Belief, NewLandmarks, Part
from rbpf.core.particles import Estimate, Prior, mixture_estimate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.runs.recordings import filter_features as run
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraRay, EpipolarRay
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig, VelocityConfig
from rbpf.systems.mono.feature_sensor import InverseDepthRays
from rbpf.systems.mono.slam import MonoSlam, particle_points, world_of
from tests.core.worlds import content, same
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, changed, desk, errors, nees, rows, without_known

ROOT = Path(__file__).resolve().parents[2]
LOG, FIRST = desk(2, frames=10), desk()
every_mode = pytest.mark.parametrize("mode", ["frame", "points"])
every_constraint = pytest.mark.parametrize("constrain", ["epipolar", "marginal", "off"])
SETTINGS = [
    SMALL,
    replace(SMALL, known="points"),
    replace(SMALL, velocity=VelocityConfig("joint"), inverse_depth=InverseDepthConfig("epipolar")),
    replace(SMALL, velocity=VelocityConfig("paper"), inverse_depth=InverseDepthConfig("off")),
]
every_setting = pytest.mark.parametrize("config", SETTINGS, ids=["default", "points", "joint", "paper"])


def kinds(filter_: Filter) -> dict[int, type]:
    """Parametrisation of each landmark, by its name."""
    held = filter_.belief().map
    return {i: type(held.landmark_of(i)) for i in held.ids.tolist()}


@every_setting
def test_compiled_equals_numpy(config):
    log = replace(LOG, frames=LOG.frames[:6])
    one, other = (run(log, replace(config, compiled=compiled)) for compiled in (True, False))
    np.testing.assert_allclose(one.log["log_evidence"], other.log["log_evidence"], atol=1e-5)
    np.testing.assert_allclose(one.log.poses, other.log.poses, atol=1e-7)
    np.testing.assert_allclose(one.system.filter.particles.state, other.system.filter.particles.state, atol=1e-6)
    np.testing.assert_array_equal(one.log["resampled"], other.log["resampled"])
    assert kinds(one.system.filter) == kinds(other.system.filter)


@every_setting
def test_equal_seeds_give_equal_bytes(config):
    first, second, other = (run(LOG, replace(config, seed=seed)) for seed in (1, 1, 2))
    assert same(content(first.system.filter), content(second.system.filter))
    assert not same(content(first.system.filter), content(other.system.filter))


THREADS = """
import hashlib
import numba
from dataclasses import replace
from rbpf.kernels.signature import PAIRS_PER_THREAD
from rbpf.runs.recordings import filter_features as run
from tests.core.worlds import content
from tests.systems.mono_logs import SMALL, desk

numba.set_num_threads({threads})
log = desk(2, frames=4, measurements=20)
rows = []
config = replace(SMALL, particles=1500, known="points")
most = lambda run, _: rows.append(max(len(group.z) for group in run.system.report.groups))
done = run(log, config, listeners=[most])
digest = hashlib.sha256()
for name, array in sorted(content(done.system.filter).items()):
    digest.update(name.encode() + array.tobytes())
print(max(rows) * 1500 >= 2 * PAIRS_PER_THREAD, digest.hexdigest())
"""


@pytest.mark.slow
def test_threads_do_not_change_a_byte():
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": str(ROOT)}
    outputs = []
    for threads in (1, 2):
        command = [sys.executable, "-c", THREADS.format(threads=threads)]
        done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        outputs.append(done.stdout.split())
    assert outputs[0] == outputs[1]
    assert outputs[0][0] == "True" and len(outputs[0][1]) == 2 * hashlib.sha256().digest_size


@every_mode
def test_rays_become_points(mode):
    """All at once in all particles, when enough of the weight is ready; none in a first frame."""
    log, seen = desk(1, frames=25), []
    note = lambda run, _: seen.append(kinds(run.system.filter))  # noqa: E731
    done = run(log, replace(SMALL, known=mode), listeners=[note])
    given = set(known(log.known).names.tolist())
    assert not any(kind is Point for name, kind in seen[0].items() if name not in given)
    promoted = [name for name, kind in seen[-1].items() if kind is Point and name not in given]
    assert len(promoted) >= 3
    for name in promoted:
        of = [kinds_[name] for kinds_ in seen if name in kinds_]
        turn = of.index(Point)
        assert turn > 0 and set(of[:turn]) == {InverseDepth} and set(of[turn:]) == {Point}
    assert InverseDepth in seen[-1].values()
    assert np.abs(errors(done)[-1]).max() < 0.2


def groups_of(constrain, log=LOG) -> list[set[tuple[type, frozenset[Part]]]]:
    """Models of rays in each frame, with what they inform."""
    found = []

    def record(run, _):
        groups = run.system.report.groups
        found.append({(type(g.model), g.updates) for g in groups if isinstance(g.model, CameraRay)})

    run(log, replace(SMALL, inverse_depth=InverseDepthConfig(constrain)), listeners=[record])
    return found


def test_how_rays_are_used():
    """E06 §5.1: without parallax a measurement of a ray says nothing about its depth."""
    state, landmark = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
    epipolar, marginal, off = (groups_of(constrain) for constrain in ("epipolar", "marginal", "off"))
    both = state | landmark
    assert set().union(*epipolar) == {(EpipolarRay, state), (CameraRay, state), (CameraRay, landmark)}
    assert set().union(*marginal) == {(EpipolarRay, state), (CameraRay, state), (CameraRay, both)}
    assert set().union(*off) == {(CameraRay, landmark)}
    assert epipolar[1] == marginal[1] == {(CameraRay, state)} and off[1] == set()
    assert epipolar[2] == marginal[2] == {(EpipolarRay, state)}


def test_without_points_the_prior_of_depth_holds_the_scale():
    """Young rays then constrain the pose by the marginal, where their prior counts."""
    found = groups_of("marginal", without_known(LOG))
    assert found[1] == {(CameraRay, frozenset({Part.STATE}))}


@every_constraint
def test_a_camera_at_rest_learns_no_depth(constrain):
    """The same image again and again."""
    frames = [replace(LOG.frames[0], stamp_ns=LOG.frames[0].stamp_ns + t * 10**8) for t in range(8)]
    still = VelocityConfig(walk_rad_s=1e-3, walk_m_s=1e-3, start_rad_s=1e-3, start_m_s=1e-3)
    config = replace(SMALL, inverse_depth=InverseDepthConfig(constrain, from_scene_depth=False), velocity=still)
    done = run(replace(LOG, frames=frames, truth=None), config)
    held = done.system.filter.belief().map
    rays = [i for i in held.ids.tolist() if isinstance(held.landmark_of(i), InverseDepth)]
    assert len(rays) == len(LOG.frames[0].landmarks) - 4
    np.testing.assert_array_equal(held.read(np.array(rays)).cov[..., 2, 2], InverseDepthConfig().std_per_m ** 2)


def still_log(seed: int, frames: int) -> FeatureLog:
    """A camera at rest sees four known points and 25 others, with 0.3 px of noise."""
    rng, camera = np.random.default_rng(seed), Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
    corners = np.array([[-0.4, -0.3, 2.0], [0.4, -0.3, 2.0], [0.4, 0.3, 2.0], [-0.4, 0.3, 2.0]])
    px = rng.uniform([20.0, 20.0], [620.0, 460.0], (25, 2))
    z = np.concatenate([camera.project(corners), px])
    cov = np.tile(0.09 * np.eye(2), (29, 1, 1))
    seen = [
        FeatureFrame(int(t * 1e9 / 30), np.arange(29), z + rng.normal(0.0, 0.3, z.shape), cov) for t in range(frames)
    ]
    known_points = KnownPoints(np.arange(4), corners, np.tile(1e-6 * np.eye(3), (4, 1, 1)))
    return FeatureLog("still", camera, seen, known_points)


@pytest.mark.parametrize("at_mm", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("constrain", ["epipolar", "marginal"])
@pytest.mark.parametrize("compiled", [True, False])
def test_what_rays_say_changes_smoothly_with_the_pose(compiled, constrain, at_mm):
    """Sideways displacements of 0 to 5 mm, one for each particle; the heaviest is somewhere among them."""
    frame, n = still_log(0, 1).frames[0], 501
    camera, ids = still_log(0, 1).camera, np.arange(25)
    rays = InverseDepthRays(camera, InverseDepthConfig(constrain))
    held = LandmarkMap(SE3, compiled=compiled)
    held.begin(n, Lineage(n))
    start = np.repeat(SE3.identity()[None], n, axis=0)
    held.add(NewLandmarks(frame.z[4:], frame.cov_z[4:], rays.model, rays.landmark, ids=ids), start)
    displaced = start.copy()
    displaced[:, 4] = np.linspace(0.0, 5e-3, n)
    heaviest = np.abs(displaced[:, 4] - 1e-3 * at_mm).argmin()
    log_weights = np.full(n, -np.log(n + 1.0))
    log_weights[heaviest] = np.log(2.0 / (n + 1.0))
    belief = Belief(log_weights, Prior.exactly(SE3, displaced), {Part.LANDMARK: held})
    z = frame.z[4:] + np.random.default_rng(1).normal(0.0, 0.3, (25, 2))
    groups = rays.observations(belief, z, frame.cov_z[4:], ids, scaled=True)
    density = held.correct(displaced, np.zeros((n, 6)), groups).all
    assert np.abs(np.diff(density[1:])).max() < 0.3  # 0.01 mm apart
    assert np.abs(np.diff(density[:2])).max() < (0.3 if at_mm < 5.0 else 30.0)  # no line where nothing has moved


def test_a_camera_at_rest_stays():
    """RMS error in the particles' own world, after 60 frames of eight recordings; lines begin late."""
    squares, late = [], InverseDepthConfig(epipolar_parallax_px=3.0)
    for seed in range(8):
        filter_ = run(
            still_log(seed, 60), MonoConfig(seed=seed, max_new_per_frame=30, inverse_depth=late)
        ).system.filter
        paths = SE3.translation(filter_.history.paths()[..., :7])
        squares.append(np.square(np.einsum("tnk,n->tk", paths, filter_.particles.weights)[-1]).sum())
    assert np.sqrt(np.mean(squares)) < 4e-3


@every_setting
def test_two_frames_at_the_same_time(config):
    """No time, no motion: the second frame is a second look from one place."""
    again = replace(LOG.frames[3], stamp_ns=LOG.frames[2].stamp_ns)
    log = replace(LOG, frames=[*LOG.frames[:3], again, *LOG.frames[4:6]], truth=None)
    states = []
    note = lambda run, _: states.append(run.system.filter.particles.state.copy())  # noqa: E731
    done = run(log, config, listeners=[note])
    assert np.isfinite(done.log["log_evidence"]).all() and np.isfinite(done.log.covs).all()
    before = {state.tobytes() for state in np.round(states[2], 9) + 0.0}
    assert {state.tobytes() for state in np.round(states[3], 9) + 0.0} <= before


@every_setting
def test_an_empty_frame(config):
    """Nothing is seen: the camera goes on and grows uncertain; afterwards it is found again."""
    nothing = np.zeros(0, dtype=np.int64)
    done = run(changed(LOG, 5, lambda f: rows(f, nothing)), config)
    volume = np.linalg.det(done.log.covs)
    assert volume[5] > 10.0 * volume[4] and volume[6] < 0.1 * volume[5]
    assert done.log["nis_dof"][5] == 0 and done.log["log_evidence"][5] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(errors(done)[-1]).max() < 0.1


def test_what_is_reported_moves_nothing(monkeypatch):
    """The start without known points adjusts the first frames; it begins where the filter is, not where it is said to be."""
    log = replace(without_known(LOG), frames=LOG.frames[:9])  # the ninth comes after an adjustment
    plain = run(log, SMALL)

    def elsewhere(report):
        found = mixture_estimate(*report.mixture)
        return Estimate(found.mean + np.repeat([0.0, 0.1e-9 * report.stamp_ns], [4, 3]), found.cov)

    monkeypatch.setattr(StepReport, "estimate", property(elsewhere))
    moved = run(log, SMALL)
    assert not np.array_equal(moved.log.poses, plain.log.poses)
    assert moved.system.start.arrays()["start/steps"].size > 0
    assert same(content(moved.system.filter), content(plain.system.filter))


def test_an_empty_first_frame_without_known_points():
    nothing = np.zeros(0, dtype=np.int64)
    log = changed(without_known(LOG), 0, lambda f: rows(f, nothing))
    done = run(replace(log, frames=log.frames[:3]), SMALL)
    assert np.isfinite(done.log.covs).all()
    assert len(done.system.filter.belief().map.ids) > 0


@every_mode
def test_a_measurement_outside_the_image_is_ignored(mode):
    """Of a known point, of a ray and of a new landmark: as if they had not been there."""
    config, outside = replace(SMALL, known=mode), np.array([700.0, -50.0])
    given = known(LOG.known).names
    frame = LOG.frames[4]
    before = {name for f in LOG.frames[:4] for name in f.landmarks.tolist()}
    ray = next(name for name in frame.landmarks.tolist() if name in before and name not in given)
    of_known = next(name for name in frame.landmarks.tolist() if name in given)
    there = ~np.isin(frame.landmarks, [ray, of_known])

    def beside(f):
        z = f.z.copy()
        z[~there] = outside
        extra = replace(rows(f, np.array([0])), landmarks=np.array([10**6]), z=outside[None])
        parts = zip(("landmarks", "z", "cov_z"), (f.landmarks, z, f.cov_z), strict=True)
        joined = {name: np.concatenate([part, getattr(extra, name)]) for name, part in parts}
        return replace(f, **joined)

    done, expected = (run(changed(LOG, 4, change), config) for change in (beside, lambda f: rows(f, there)))
    assert same(content(done.system.filter), content(expected.system.filter))
    np.testing.assert_array_equal(done.log.poses, expected.log.poses)
    untouched = run(LOG, config)
    assert not np.array_equal(done.log.poses[4], untouched.log.poses[4])


def scores(known_as: str, seeds: range) -> np.ndarray:
    """NEES (runs, frames)."""

    def one(seed: int) -> Run:
        config = MonoConfig(particles=30, seed=seed, known=known_as)
        return run(desk(100 + seed, frames=12), config)

    return np.array([nees(one(seed)) for seed in seeds])


@pytest.mark.slow
def test_the_stated_uncertainty():
    """Mean NEES, 6 if consistent: near it as a frame; separate landmarks lose what the frame keeps together."""
    frame, points = (scores(mode, range(24)) for mode in ("frame", "points"))
    std = np.sqrt(2.0 * 6.0 / 24)
    late = slice(6, 12)
    assert abs(frame[:, 0].mean() - 6.0) < 4.0 * std and abs(points[:, 0].mean() - 6.0) < 4.0 * std
    assert abs(frame[:, late].mean() - 6.0) < 4.0 * std
    assert points[:, late].mean() > 6.0 + 4.0 * std


# How it starts.

every_velocity = pytest.mark.parametrize("velocity", ["marginal", "joint", "paper"])


def first_only(log: FeatureLog) -> FeatureLog:
    return replace(log, frames=log.frames[:1])


@every_velocity
@every_mode
def test_the_first_frame_finds_the_camera(mode, velocity):
    """Within four standard deviations of the truth, which are as small as the pixels' noise makes them."""
    config = replace(SMALL, known=mode, velocity=VelocityConfig(velocity))
    done = run(first_only(FIRST), config)
    std = np.sqrt(np.diag(done.log.covs[0]))
    assert (std[:3] < 0.03).all() and (std[3:] < 0.03).all() and (std > 1e-4).all()
    truth = known(FIRST.truth).world_from_camera[:1]
    assert (np.abs(SE3.local(done.log.poses, truth)[0]) < 4.0 * std).all()


def test_a_frame_says_the_same_in_both_modes():
    """The law of the first pose is a matter of the known points, not of what stands for them."""
    frame, points = (run(first_only(FIRST), replace(SMALL, known=mode, particles=200)) for mode in ("frame", "points"))
    std = np.sqrt(np.diag(frame.log.covs[0]))
    offset = SE3.local(frame.log.poses[0], points.log.poses[0]) / std
    assert np.abs(offset).max() < 0.5
    ratio = np.sqrt(np.diag(points.log.covs[0])) / std
    assert (np.abs(np.log(ratio)) < 0.3).all()


def started(log: FeatureLog, config: MonoConfig) -> Filter:
    """After the first frame."""
    slam = MonoSlam(log.camera, config, log.known)
    slam.take(log.frames[0])
    return slam.filter


def test_known_points_in_the_map():
    given = known(FIRST.known)
    none_new = replace(SMALL, max_new_per_frame=0)
    frame = started(FIRST, none_new)
    (landmark,) = frame.belief().map.ids.tolist()
    assert isinstance(frame.belief().map.landmark_of(landmark), UncertainConstellation)
    exact = replace(FIRST, known=replace(given, cov=np.zeros((4, 3, 3))))
    rigid = started(exact, none_new).belief().map
    assert isinstance(rigid.landmark_of(int(rigid.ids[0])), Constellation)
    assert world_of(frame) is not None
    slam = MonoSlam(FIRST.camera, replace(SMALL, known="points"), given)
    slam._begin(FIRST.frames[0])
    points, held = slam.filter, slam.filter.belief().map
    assert held.ids.tolist() == given.names.tolist()
    np.testing.assert_array_equal(held.read(held.ids).mean[3], given.positions)
    np.testing.assert_allclose(held.read(held.ids).cov[3], given.cov)
    assert world_of(points) is None


@every_mode
def test_first_sightings_become_rays(mode):
    done = run(first_only(FIRST), replace(SMALL, known=mode))
    held, names = done.system.filter.belief().map, known(FIRST.known).names
    rays = [i for i in held.ids.tolist() if isinstance(held.landmark_of(i), InverseDepth)]
    assert sorted(rays) == sorted(np.setdiff1d(FIRST.frames[0].landmarks, names).tolist())


def test_at_most_so_many_new_landmarks():
    done = run(replace(FIRST, frames=FIRST.frames[:2]), replace(SMALL, max_new_per_frame=3))
    assert len(done.system.filter.belief().map.ids) == 1 + 3 + 3


@every_velocity
def test_without_known_points_the_first_camera_is_the_world(velocity):
    """Its pose is certain, its velocity as uncertain as the settings say."""
    log, settings = without_known(FIRST), VelocityConfig(velocity, start_rad_s=0.3, start_m_s=0.2)
    config = replace(SMALL, particles=2000, velocity=settings)
    slam = MonoSlam(log.camera, config)
    tracked, filter_ = slam.take(log.frames[0]), slam.filter
    np.testing.assert_array_equal(filter_.particles.state[:, :7], SE3.identity((2000,)))
    np.testing.assert_array_equal(tracked.cov, np.zeros((6, 6)))
    expected = np.repeat([0.3, 0.2], 3)
    if velocity == "marginal":
        substate = list(filter_.marginals.parts.values())[-1]
        np.testing.assert_allclose(np.sqrt(np.diag(substate.cov[0])), expected)
    else:
        np.testing.assert_allclose(filter_.particles.state[:, 7:].std(axis=0), expected, rtol=0.1)


@every_velocity
def test_without_known_points_it_runs(velocity):
    """The scale is that of the prior of depth; directions are right."""
    log = without_known(FIRST)
    done = run(log, replace(SMALL, velocity=VelocityConfig(velocity)))
    truth = known(log.truth).world_from_camera
    relative = SE3.between(truth[0], truth)
    assert np.isfinite(done.log["log_evidence"]).all()
    turned = SE3.local(done.log.poses, relative)[:, :3]
    assert np.linalg.norm(turned, axis=1).max() < 0.1
    assert world_of(done.system.filter) is None


def test_landmarks_in_the_known_world():
    """Points of the map where they are, though each particle has its own world."""
    log = desk(1, frames=25)
    done = run(log, SMALL)
    held, places = done.system.filter.belief().map, known(log.truth).landmarks
    ids = [i for i in held.ids.tolist() if isinstance(held.landmark_of(i), Point)]
    assert len(ids) >= 3
    cloud = particle_points(done.system.filter, ids)
    assert cloud.shape == (20, len(ids), 3)
    true = np.array([places[i] for i in ids])
    mean = done.system.filter.particles.weights @ cloud.reshape(20, -1)
    assert np.median(np.linalg.norm(mean.reshape(-1, 3) - true, axis=1)) < 0.05
    raw = held.read(np.array(ids)).mean
    assert np.median(np.linalg.norm(raw[0] - true, axis=1)) > 0.5


def test_a_stereo_log():
    log = simulate_features(DeskWorld(frames=2, points=60), Measuring(), STEREO, 0)
    with pytest.raises(InputError, match="needs a log of one camera, this is a stereo log"):
        run(log, SMALL)


@every_mode
@pytest.mark.parametrize("count", [0, 3])
def test_too_few_known_points(mode, count):
    """Of those that are given, only those that the first frame sees count."""
    names = known(FIRST.known).names
    hidden = changed(FIRST, 0, lambda f: rows(f, ~np.isin(f.landmarks, names[count:])))
    with pytest.raises(InputError, match=f"needs at least four that are seen, got {count}"):
        run(hidden, replace(SMALL, known=mode))


@every_mode
def test_one_known_point_outside_the_image(mode):
    """Beyond the border it is no measurement: not of the start either."""
    names = known(FIRST.known).names

    def moved(frame: FeatureFrame) -> FeatureFrame:
        z = frame.z.copy()
        z[frame.landmarks == names[0]] = [5000.0, -3000.0]
        return replace(frame, z=z)

    with pytest.raises(InputError, match="needs at least four that are seen, got 3"):
        run(changed(FIRST, 0, moved), replace(SMALL, known=mode))
    five = desk(0, known=5)
    names = known(five.known).names
    done = run(first_only(changed(five, 0, moved)), replace(SMALL, known=mode))
    assert np.abs(errors(done)[0]).max() < 0.1


@every_mode
def test_known_points_on_a_line(mode):
    given = known(FIRST.known)
    line = given.positions[0] + np.outer(np.arange(4.0), given.positions[1] - given.positions[0])
    log = replace(FIRST, known=KnownPoints(given.names, line, given.cov))
    with pytest.raises(InputError, match="the known points lie on a line"):
        run(log, replace(SMALL, known=mode))


def test_more_known_points_than_a_group_has_errors_for():
    log = desk(known=13, measurements=30)
    with pytest.raises(InputError, match="13 known points have errors of their own: give at most 12"):
        MonoSlam(log.camera, SMALL, log.known)
    exact = replace(known(log.known), cov=np.zeros((13, 3, 3)))
    done = run(first_only(replace(log, known=exact)), SMALL)
    assert np.abs(errors(done)[0]).max() < 0.05


def test_a_name_that_comes_twice():
    with pytest.raises(InputError, match=r"frame 2 of .*: landmark 7 comes twice"):
        changed(FIRST, 2, lambda f: replace(f, landmarks=np.full(len(f.landmarks), 7)))


def test_a_negative_name():
    log = changed(FIRST, 1, lambda f: replace(f, landmarks=-1 - np.arange(len(f.landmarks))))
    with pytest.raises(InputError, match="a landmark has a negative name"):
        run(log, SMALL)
