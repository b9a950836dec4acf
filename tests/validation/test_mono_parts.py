"""Perfect parts: matches, depths and a calibration from the batch, where all is known."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.systems.mono.run import run
from rbpf.validation.gtsam.mono_batch import Batch, adjust_log
from rbpf.validation.mono_parts import (
    DEPTH_FRACTION,
    GivenDepths,
    agreeing_matches,
    batch_depths,
    reprojection_errors,
)
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL

pytestmark = pytest.mark.slow

FRAMES = 40


@pytest.fixture(scope="module")
def log() -> FeatureLog:
    return simulate_features(DeskWorld(frames=FRAMES), Measuring(noise_px=0.3), MONO, 5)


@pytest.fixture(scope="module")
def batch(log) -> Batch:
    return adjust_log(log, known(log.truth).world_from_camera)


def test_the_wrong_matches_are_found_and_no_others(log, batch):
    rng = np.random.default_rng(0)
    names, counts = np.unique(np.concatenate([f.landmarks for f in log.frames]), return_counts=True)
    often = names[counts >= 10]  # of two sightings nobody can tell which one is wrong
    frames, wrong = [], {}
    for t, frame in enumerate(log.frames):
        z = frame.z.copy()
        row = int(rng.choice(np.flatnonzero(np.isin(frame.landmarks, often))))
        if t % 3 == 0:
            z[row] += [20.0, -15.0]
            wrong[t] = frame.landmarks[row]
        frames.append(FeatureFrame(frame.stamp_ns, frame.landmarks, z, frame.cov_z))
    spoilt = replace(log, frames=frames)
    clean = agreeing_matches(spoilt, adjust_log(spoilt, batch.world_from_camera))
    for t, (left, all_) in enumerate(zip(clean.frames, log.frames, strict=True)):
        gone = np.setdiff1d(all_.landmarks, left.landmarks).tolist()
        assert gone == ([wrong[t]] if t in wrong else [])


def test_reprojection_errors_are_as_large_as_the_noise(batch):
    errors = np.concatenate(reprojection_errors(batch))
    errors = errors[np.isfinite(errors)]
    assert 0.3 < np.sqrt(np.square(errors).mean()) < 0.3 * np.sqrt(2.0) + 0.02


def test_depths_are_the_true_ones(log, batch):
    depths, truth = batch_depths(batch), known(log.truth)
    first = {}
    for frame, pose in zip(log.frames, truth.world_from_camera, strict=True):
        for name in frame.landmarks.tolist():
            first.setdefault(name, SE3.inverse_transform(pose, truth.landmarks[name])[2])
    assert len(depths) > 30
    fraction = np.array([depths[name] / first[name] - 1.0 for name in depths])
    assert np.median(np.abs(fraction)) < 0.02


def test_landmarks_start_at_the_given_depths(log, batch):
    depths = batch_depths(batch)
    done = run(replace(log, frames=log.frames[:1]), SMALL, wrapped=lambda sensor: GivenDepths(sensor, depths))
    belief = done.filter.belief()
    rays = {name: i for i, name in belief.catalogue.items() if name in depths}
    assert len(rays) > 10
    records = belief.read(np.array(list(rays.values())))
    rho = np.array([1.0 / depths[name] for name in rays])
    np.testing.assert_allclose(records.mean[0, :, 2], rho, rtol=1e-9)
    np.testing.assert_allclose(np.sqrt(records.cov[0, :, 2, 2]), DEPTH_FRACTION * rho, rtol=1e-6)
