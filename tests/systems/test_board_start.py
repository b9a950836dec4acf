"""A run that starts from a rendered chessboard: its corners look alike, and are told apart all the same."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from rbpf.lie import SE3
from rbpf.runs.recordings import MonoRecording, filter_images
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.calibration import Board
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.gtsam.mono_batch import adjust_log
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.desk_and_room import OVER_DESK, TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

CAMERA = Pinhole(320, 240, 256.0, 256.0, 159.5, 119.5)
BOARD = Board(7, 4, 0.06)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """The run, and the true poses in the board's frame."""
    folder = tmp_path_factory.mktemp("board") / "desk"
    world = TexturedDesk(
        frames=60, board=(8, 5), square_m=0.06, hand=replace(OVER_DESK, speed_m_s=0.6, turn_rad_s=1.0, start_s=0.3)
    )
    imaging = Imaging(noise_std=1.0, blur_s=0.0, exposure_drift=0.0, vignetting=0.0, known=0)
    simulate_images(world, imaging, CAMERA, folder, seed=0)
    sequence, known = MonoRecording(folder, board=BOARD).sequence()
    entry = yaml.safe_load((folder / "chessboard.yaml").read_text())[0]
    assert sequence.truth is not None
    board_from_world = SE3.inverse(np.array(entry["world_from_board"]))
    truth = SE3.compose(board_from_world, sequence.truth.world_from_camera)
    return filter_images(sequence, MonoConfig(), known), truth


def test_every_corner_is_found_at_its_own_place(started):
    run, truth = started
    count = 0
    for sighting, pose in zip(run.log.all_observed(), truth, strict=True):
        found = np.isfinite(sighting["px"]).all(axis=1)
        mine = found & (sighting["features"] < run.system.known_points.names.size)
        places = run.system.known_points.positions[sighting["features"][mine]]
        px = run.source.camera.project(SE3.inverse_transform(pose, places))
        assert (np.linalg.norm(px - sighting["px"][mine], axis=1) < 2.0).all()
        count += int(mine.sum())
    assert count > 4 * truth.shape[0]
    assert not run.log.lost().any()


def test_the_first_camera_is_right_to_one_per_cent(started):
    run, truth = started
    distance = np.linalg.norm(truth[0, 4:])
    assert np.linalg.norm(run.log.poses[0, 4:] - truth[0, 4:]) < 0.01 * distance


def test_the_measurements_have_the_board_s_scale_to_one_per_cent(started):
    run, truth = started
    batch = adjust_log(run.system.measurements(run.name, run.log), run.log.poses)
    reference = Trajectory(run.log.stamps_ns, truth).at(batch.frames)
    assert abs(ate(batch.trajectory, reference, "similarity").alignment.scale - 1.0) < 0.01
