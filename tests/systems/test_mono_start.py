"""How a monocular run starts: from known points, from nothing, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation, UncertainConstellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.point import Point
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.systems.mono.config import MonoConfig, VelocityConfig
from rbpf.systems.mono.run import landmark_cloud, run
from rbpf.systems.mono.system import build_filter, start_prior, world_of
from rbpf.validation.simulation.features import STEREO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, changed, desk, errors, rows, without_known

LOG = desk()
every_mode = pytest.mark.parametrize("mode", ["frame", "points"])
every_velocity = pytest.mark.parametrize("velocity", ["marginal", "joint", "paper"])


def first_only(log: FeatureLog) -> FeatureLog:
    return replace(log, frames=log.frames[:1])


@every_velocity
@every_mode
def test_the_first_frame_finds_the_camera(mode, velocity):
    """Within four standard deviations of the truth, which are as small as the pixels' noise makes them."""
    config = replace(SMALL, known=mode, velocity=VelocityConfig(velocity))
    done = run(first_only(LOG), config)
    std = np.sqrt(np.diag(done.cov[0]))
    assert (std[:3] < 0.03).all() and (std[3:] < 0.03).all() and (std > 1e-4).all()
    truth = known(LOG.truth).world_from_camera[:1]
    assert (np.abs(SE3.local(done.world_from_camera, truth)[0]) < 4.0 * std).all()


def test_a_frame_says_the_same_in_both_modes():
    """The law of the first pose is a matter of the known points, not of what stands for them."""
    frame, points = (
        run(first_only(LOG), replace(SMALL, known=mode, particles=200)) for mode in ("frame", "points")
    )
    std = np.sqrt(np.diag(frame.cov[0]))
    offset = SE3.local(frame.world_from_camera[0], points.world_from_camera[0]) / std
    assert np.abs(offset).max() < 0.5
    ratio = np.sqrt(np.diag(points.cov[0])) / std
    assert (np.abs(np.log(ratio)) < 0.3).all()


def test_known_points_in_the_map():
    given = known(LOG.known)
    frame = build_filter(LOG, replace(SMALL, known="frame"))
    (landmark,) = frame.belief().map.ids.tolist()
    assert isinstance(frame.belief().map.landmark_of(landmark), UncertainConstellation)
    exact = replace(LOG, known=replace(given, cov=np.zeros((4, 3, 3))))
    rigid = build_filter(exact, replace(SMALL, known="frame")).belief().map
    assert isinstance(rigid.landmark_of(int(rigid.ids[0])), Constellation)
    assert world_of(frame) is not None
    points = build_filter(LOG, replace(SMALL, known="points"))
    held = points.belief().map
    assert [held.catalogue[i] for i in held.ids.tolist()] == given.names.tolist()
    np.testing.assert_array_equal(held.read(held.ids).mean[3], given.positions)
    np.testing.assert_allclose(held.read(held.ids).cov[3], given.cov)
    assert world_of(points) is None


@every_mode
def test_first_sightings_become_rays(mode):
    done = run(first_only(LOG), replace(SMALL, known=mode))
    held, names = done.filter.belief().map, known(LOG.known).names
    rays = [held.catalogue[i] for i in held.ids.tolist() if isinstance(held.landmark_of(i), InverseDepth)]
    assert sorted(rays) == sorted(np.setdiff1d(LOG.frames[0].landmarks, names).tolist())


def test_at_most_so_many_births():
    done = run(replace(LOG, frames=LOG.frames[:2]), replace(SMALL, max_new_per_frame=3))
    assert len(done.filter.belief().map.ids) == 1 + 3 + 3


@every_velocity
def test_without_known_points_the_first_camera_is_the_world(velocity):
    """Its pose is certain, its velocity as uncertain as the settings say."""
    log, settings = without_known(LOG), VelocityConfig(velocity, start_rad_s=0.3, start_m_s=0.2)
    config = replace(SMALL, particles=2000, velocity=settings)
    filter_ = build_filter(log, config)
    report = filter_.step(log.frames[0], start_prior(log, config), log.frames[0].stamp_ns)
    np.testing.assert_array_equal(filter_.particles.state[:, :7], SE3.identity((2000,)))
    np.testing.assert_array_equal(report.estimate.cov[:6, :6], np.zeros((6, 6)))
    expected = np.repeat([0.3, 0.2], 3)
    if velocity == "marginal":
        substate = list(filter_.marginals.parts.values())[-1]
        np.testing.assert_allclose(np.sqrt(np.diag(substate.cov[0])), expected)
    else:
        np.testing.assert_allclose(filter_.particles.state[:, 7:].std(axis=0), expected, rtol=0.1)


@every_velocity
def test_without_known_points_it_runs(velocity):
    """The scale is that of the prior of depth; directions are right."""
    log = without_known(LOG)
    done = run(log, replace(SMALL, velocity=VelocityConfig(velocity)))
    truth = known(log.truth).world_from_camera
    relative = SE3.between(truth[0], truth)
    assert np.isfinite(done.log_evidence).all()
    turned = SE3.local(done.world_from_camera, relative)[:, :3]
    assert np.linalg.norm(turned, axis=1).max() < 0.1
    assert world_of(done.filter) is None


def test_landmarks_in_the_known_world():
    """Points of the map where they are, though each particle has its own world."""
    log = desk(1, frames=25)
    done = run(log, SMALL)
    held, places = done.filter.belief().map, known(log.truth).landmarks
    ids = [i for i in held.ids.tolist() if isinstance(held.landmark_of(i), Point)]
    assert len(ids) >= 3
    cloud = landmark_cloud(done.filter, ids)
    assert cloud.shape == (20, len(ids), 3)
    true = np.array([places[held.catalogue[i]] for i in ids])
    mean = done.filter.particles.weights @ cloud.reshape(20, -1)
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
    names = known(LOG.known).names
    hidden = changed(LOG, 0, lambda f: rows(f, ~np.isin(f.landmarks, names[count:])))
    with pytest.raises(InputError, match=f"needs at least four that are seen, got {count}"):
        run(hidden, replace(SMALL, known=mode))


@every_mode
def test_one_known_point_outside_the_image(mode):
    """Beyond the border it is no measurement: not of the start either."""
    names = known(LOG.known).names

    def moved(frame: FeatureFrame) -> FeatureFrame:
        z = frame.z.copy()
        z[frame.landmarks == names[0]] = [5000.0, -3000.0]
        return replace(frame, z=z)

    with pytest.raises(InputError, match="needs at least four that are seen, got 3"):
        run(changed(LOG, 0, moved), replace(SMALL, known=mode))
    five = desk(0, known=5)
    names = known(five.known).names
    done = run(first_only(changed(five, 0, moved)), replace(SMALL, known=mode))
    assert np.abs(errors(done)[0]).max() < 0.1


@every_mode
def test_known_points_on_a_line(mode):
    given = known(LOG.known)
    line = given.positions[0] + np.outer(np.arange(4.0), given.positions[1] - given.positions[0])
    log = replace(LOG, known=KnownPoints(given.names, line, given.cov))
    with pytest.raises(InputError, match="the known points lie on a line"):
        run(log, replace(SMALL, known=mode))


def test_more_known_points_than_a_group_has_errors_for():
    log = desk(known=13, measurements=30)
    with pytest.raises(InputError, match="13 known points have errors of their own: give at most 12"):
        build_filter(log, SMALL)
    exact = replace(known(log.known), cov=np.zeros((13, 3, 3)))
    done = run(first_only(replace(log, known=exact)), SMALL)
    assert np.abs(errors(done)[0]).max() < 0.05


def test_a_name_that_comes_twice():
    with pytest.raises(InputError, match=r"frame 2 of .*: landmark 7 comes twice"):
        changed(LOG, 2, lambda f: replace(f, landmarks=np.full(len(f.landmarks), 7)))


def test_a_negative_name():
    log = changed(LOG, 1, lambda f: replace(f, landmarks=-1 - np.arange(len(f.landmarks))))
    with pytest.raises(InputError, match="a landmark has a negative name"):
        run(log, SMALL)


def test_no_particles():
    with pytest.raises(InputError, match="particles must be at least 1, got 0"):
        MonoConfig(particles=0)
