"""The recordings in MRPT's tables: counts, and odometry and sightings against the truth."""

import numpy as np
import pytest

from rbpf.sensors.readers import open_log


def opened(folder):
    return open_log(folder)


def dead_reckoned(log):
    path = [log.space.identity()]
    for frame in log.frames[1:]:
        path.append(log.space.compose(path[-1], frame.delta))
    return np.array(path)


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("folder", "frames", "sightings", "landmarks", "path_rmse"),
    [("mrpt_kf_slam_2d", 250, 3607, 70, 0.681), ("mrpt_kf_slam_6d", 600, 5824, 50, 1.156)],
)
def test_recordings(data_dir, folder, frames, sightings, landmarks, path_rmse):
    log = opened(data_dir / folder)
    space, truth = log.space, log.truth
    assert len(log.frames) == frames
    assert sum(len(frame.z) for frame in log.frames) == sightings
    assert len(truth.landmarks) == landmarks
    offset = space.translation(dead_reckoned(log)) - space.translation(truth.world_from_robot)
    assert np.sqrt(np.square(offset).sum(1).mean()) == pytest.approx(path_rmse, abs=5e-4)
    deltas = np.stack([frame.delta for frame in log.frames[1:]])
    errors = space.local(deltas, space.between(truth.world_from_robot[:-1], truth.world_from_robot[1:]))
    nees = [e @ np.linalg.solve(frame.cov_delta, e) for e, frame in zip(errors, log.frames[1:], strict=True)]
    spread = np.sqrt(2 * space.dim / len(nees))
    assert np.mean(nees) == pytest.approx(space.dim, abs=3 * spread)


@pytest.mark.real_data
@pytest.mark.parametrize("folder", ["mrpt_kf_slam_2d", "mrpt_kf_slam_6d"])
def test_sightings_agree_with_the_truth_within_their_noise(data_dir, folder):
    log = opened(data_dir / folder)
    parts = []
    for world_from_robot, frame in zip(log.truth.world_from_robot, log.frames, strict=True):
        points = np.array([log.truth.landmarks[name] for name in frame.landmarks.tolist()])
        x, y, *up = log.space.inverse_transform(world_from_robot, points).T
        predicted = [np.sqrt(x**2 + y**2 + sum(h**2 for h in up)), np.arctan2(y, x)]
        predicted += [log.pitch_sign * np.arctan2(h, np.hypot(x, y)) for h in up]
        residual = frame.z - np.stack(predicted, axis=1)
        parts.append(residual / np.sqrt(np.einsum("kii->ki", frame.cov_z)))
    normalised = np.concatenate(parts)
    np.testing.assert_allclose(normalised.std(0), 1.0, atol=0.05)
    np.testing.assert_allclose(normalised.mean(0), 0.0, atol=0.06)
