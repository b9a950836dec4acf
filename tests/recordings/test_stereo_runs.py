"""Stereo SLAM on recordings, beside its own odometry and, where the association is known, the batch optimum."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.stereo_revisit import Reordered, pairs_there_and_back
from examples.studies.stereo_revisit import scores as scores_of
from examples.studies.stereo_tracks import read_stereo_tracks
from rbpf.runs.recordings import filter_features, filter_pairs
from rbpf.runs.run import Run
from rbpf.runs.truth import RunTruth
from rbpf.sensors.readers import open_stereo
from rbpf.systems.stereo.config import MapConfig, StereoConfig
from rbpf.validation.gtsam.camera import solve_features

pytestmark = pytest.mark.real_data


def scores(run: Run) -> dict[str, float]:
    assert run.failure is None and run.messages == []
    return scores_of(run)


def test_a_room_in_part(data_dir):
    """The first 30 pairs of the room, with a quarter of the particles."""
    sequence = open_stereo(data_dir / "stereo_zed_room1")
    rows = list(range(30))
    stamps = sequence.stamps_ns[rows]
    part = replace(sequence, stamps_ns=stamps, source=Reordered(sequence, np.array(rows), stamps))
    run = filter_pairs(part, StereoConfig(particles=100))
    found = scores(run)
    assert found["ate_rmse_m"] < 0.009
    assert 5 <= run.log["updated"].sum() < 30  # at first the camera is at rest
    assert run.log["observed"][-1] > 20  # the map fills by 15 keys an update


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_room(data_dir, seed):
    """The truth is good to about a centimetre."""
    run = filter_pairs(open_stereo(data_dir / "stereo_zed_room1"), StereoConfig(seed=seed))
    found = scores(run)
    assert len(run.log) == 105
    assert found["ate_rmse_m"] <= 0.009
    assert found["ate_rmse_m"] <= found["vo_ate_rmse_m"]


@pytest.mark.slow
def test_the_road(data_dir):
    """The median of three seeds is level with that of their odometry, and better but for the scale."""
    sequence = open_stereo(data_dir / "stereo_kitti_seq1")
    found = [scores(filter_pairs(sequence, StereoConfig(seed=seed))) for seed in range(3)]
    median = {name: np.median([one[name] for one in found]) for name in found[0]}
    assert median["ate_sim3_rmse_m"] <= 0.035
    assert median["ate_rmse_m"] <= 0.25
    assert median["ate_rmse_m"] <= 1.05 * median["vo_ate_rmse_m"]
    assert median["ate_sim3_rmse_m"] <= median["vo_ate_sim3_rmse_m"]


@pytest.mark.slow
def test_there_and_back_again(data_dir):
    """A path that comes back: with the map better than without, along all of it."""
    sequence = pairs_there_and_back(open_stereo(data_dir / "stereo_zed_room1"))
    run = filter_pairs(sequence, StereoConfig())
    found = scores(run)
    assert found["ate_rmse_m"] <= 0.009
    assert found["ate_rmse_m"] < found["vo_ate_rmse_m"]
    off = scores(filter_pairs(sequence, StereoConfig(map=MapConfig(used=False))))
    assert found["ate_rmse_m"] < off["ate_rmse_m"]


@pytest.mark.slow
def test_beside_the_batch(data_dir):
    """Recorded tracks, ten frames of 700: no truth, so that the batch optimum of the same pixels takes its place."""
    tracks = read_stereo_tracks(data_dir / "gtsam_stereo_vo")
    log = replace(tracks.log, frames=tracks.log.frames[:10])
    run = filter_features(log, StereoConfig())
    batch = solve_features(log, robust=1.345, marginals=False).world_from_camera
    run.truth = RunTruth(np.arange(len(batch)), batch)
    found = scores_of(run)
    length = np.linalg.norm(np.diff(batch[:, 4:], axis=0), axis=1).sum()
    assert found["ate_rmse_m"] < 0.002 * length
    assert found["ate_rmse_m"] < found["vo_ate_rmse_m"]
