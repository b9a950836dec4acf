"""A camera that may be relocalise_globally: matches with the map are taken if enough of them agree on one motion."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.sensors.features import Sift
from rbpf.sensors.stereo.matching import StereoMatcher
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.stereo.config import StereoConfig, TriggerConfig
from rbpf.systems.stereo.particle_subsample import ParticleSubsample
from rbpf.systems.stereo.run import StereoRun, run_images
from rbpf.systems.stereo.sensor import StereoFrame
from tests.systems.stereo_sequences import pairs

pytestmark = pytest.mark.usefixtures("keypoints_once")
COUNT = 10
CONFIG = StereoConfig(
    particles=60,
    trigger=TriggerConfig(0.0, 0.0),
    likelihood=replace(StereoConfig().likelihood, kind="outliers"),
    proposal=ProposalConfig("ekf", iterations=3),
)
WIDE = Odometry(SE3.identity(), np.diag(np.repeat([0.1**2, 0.2**2], 3)))


@pytest.fixture
def settled(keypoints_once: None) -> StereoRun:
    """Before the last pair, which shows what the map has."""
    return run_images(pairs(COUNT), CONFIG)


def last_features(run: StereoRun):
    frame = list(pairs(COUNT).frames())[-1]
    return StereoMatcher(run.front_end.rig, Sift(CONFIG.sift), CONFIG.pair).measure(frame.image, frame.right)


def spoilt(run: StereoRun, features, fraction: float):
    """Some features' pixels are exchanged among one another."""
    rng, z = np.random.default_rng(0), features.z.copy()
    rows = rng.permutation(len(features))[: int(fraction * len(features))]
    z[rows] = z[np.roll(rows, 1)]
    rig = run.front_end.rig
    return features.measured(rig, z, features.cov, features.scale, features.orientation, features.descriptors)


def test_false_matches_do_not_agree(settled):
    """Half of the places are wrong: those that are taken are right, and the camera is found."""
    features = last_features(settled)
    before = settled.world_from_camera[-1]
    wrong = spoilt(settled, features, 0.5)
    right = np.abs(wrong.z - features.z).max(axis=1) == 0.0
    sensor = settled.front_end.sensor
    known = sensor.manager.next_name
    settled.filter.step(StereoFrame(wrong), WIDE)
    taken = (sensor.names >= 0) & (sensor.names < known)
    at = settled.filter.estimate().mean
    assert taken.sum() >= CONFIG.map.agreeing
    assert right[taken].mean() > 0.9
    off = SE3.local(before, at)
    assert np.linalg.norm(off[:3]) < 0.01 and np.linalg.norm(off[3:]) < 0.02


def test_too_few_are_not_taken(settled):
    features, sensor = last_features(settled), settled.front_end.sensor
    few = features.take(np.flatnonzero(sensor.names >= 0)[: CONFIG.map.agreeing - 1])
    report = settled.filter.step(StereoFrame(few), WIDE)
    assert report.groups == []
    spread = np.sqrt(np.diagonal(settled.filter.estimate().cov)[3:])
    assert spread.min() > 0.1


def test_without_doubt_few_are_enough(settled):
    """The gate tells true from false."""
    features, sensor = last_features(settled), settled.front_end.sensor
    few = features.take(np.flatnonzero(sensor.names >= 0)[: CONFIG.map.agreeing - 1])
    report = settled.filter.step(StereoFrame(few), Odometry(SE3.identity(), 1e-6 * np.eye(6)))
    assert sum((group.ids >= 0).sum() for group in report.groups) >= 3


def test_the_cloud_speaks_for_all(settled):
    """Its expectations against those of the belief, of all particles."""
    filter_, sensor = settled.filter, settled.front_end.sensor
    belief = filter_.belief()
    ids = belief.map.ids[:12]
    cloud = ParticleSubsample.of(belief, 60)
    found = cloud.expected(belief, sensor.model, ids)
    mean, cov = belief.project(sensor.model, ids)
    np.testing.assert_allclose(found.mean, mean, atol=0.05)
    ratio = np.diagonal(found.cov, axis1=1, axis2=2) / np.diagonal(cov, axis1=1, axis2=2)
    assert ratio.min() > 0.5 and ratio.max() < 2.0
    assert cloud.rows[-1] == belief.mode and cloud.rows.size == 61
