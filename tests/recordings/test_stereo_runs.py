"""Stereo SLAM on recordings, beside its own odometry."""

import numpy as np
import pytest

from examples.studies.stereo_revisit import pairs_there_and_back
from examples.studies.stereo_revisit import scores as scores_of
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.runs.run import Run
from rbpf.sensors.readers import open_stereo
from rbpf.systems.stereo.config import MapConfig, StereoConfig

pytestmark = [pytest.mark.real_data, pytest.mark.slow, pytest.mark.usefixtures("keypoints_once")]


def scores(run: Run) -> dict[str, float]:
    assert run.failure is None and run.messages == []
    return scores_of(run)


def test_the_room(data_dir):
    """The truth is good to about a centimetre."""
    run = filter_opened(open_pairs(open_stereo(data_dir / "stereo_zed_room1"), StereoConfig()))
    found = scores(run)
    assert len(run.log) == 105
    assert found["ate_rmse_m"] <= 0.009
    assert found["ate_rmse_m"] <= found["vo_ate_rmse_m"]


def test_the_road(data_dir):
    """The median of three seeds is level with that of their odometry, and better but for the scale."""
    sequence = open_stereo(data_dir / "stereo_kitti_seq1")
    found = [scores(filter_opened(open_pairs(sequence, StereoConfig(seed=seed)))) for seed in range(3)]
    median = {name: np.median([one[name] for one in found]) for name in found[0]}
    assert median["ate_sim3_rmse_m"] <= 0.035
    assert median["ate_rmse_m"] <= 0.25
    assert median["ate_rmse_m"] <= 1.05 * median["vo_ate_rmse_m"]
    assert median["ate_sim3_rmse_m"] <= median["vo_ate_sim3_rmse_m"]


def test_there_and_back_again(data_dir):
    """A path that comes back: with the map better than without, along all of it."""
    sequence = pairs_there_and_back(open_stereo(data_dir / "stereo_zed_room1"))
    run = filter_opened(open_pairs(sequence, StereoConfig()))
    found = scores(run)
    assert found["ate_rmse_m"] <= 0.009
    assert found["ate_rmse_m"] < found["vo_ate_rmse_m"]
    off = scores(filter_opened(open_pairs(sequence, StereoConfig(map=MapConfig(used=False)))))
    assert found["ate_rmse_m"] < off["ate_rmse_m"]
