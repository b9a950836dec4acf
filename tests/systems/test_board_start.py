"""A run that starts from a rendered chessboard: its corners look alike, and are told apart all the same."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from rbpf.lie import SE3
from rbpf.runs.recordings import MonoRecording, filter_images
from rbpf.sensors.calibration import Board
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.simulation.desk_and_room import OVER_DESK, TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

CAMERA = Pinhole(320, 240, 256.0, 256.0, 159.5, 119.5)
BOARD = Board(7, 4, 0.06)

pytestmark = pytest.mark.slow


def test_every_corner_is_found_at_its_own_place(tmp_path):
    hand = replace(OVER_DESK, speed_m_s=0.6, turn_rad_s=1.0, start_s=0.3)
    world = TexturedDesk(frames=30, board=(8, 5), square_m=0.06, hand=hand)
    imaging = Imaging(noise_std=1.0, blur_s=0.0, exposure_drift=0.0, vignetting=0.0, known=0)
    simulate_images(world, imaging, CAMERA, tmp_path / "desk", seed=0)
    sequence, known = MonoRecording(tmp_path / "desk", board=BOARD).sequence()
    board_from_world = SE3.inverse(
        np.array(yaml.safe_load((tmp_path / "desk/chessboard.yaml").read_text())[0]["world_from_board"])
    )
    truth = SE3.compose(board_from_world, sequence.truth.world_from_camera)
    run, count = filter_images(sequence, MonoConfig(), known), 0
    for sighting, pose in zip(run.log.all_observed(), truth, strict=True):
        found = np.isfinite(sighting["px"]).all(axis=1)
        mine = found & (sighting["features"] < known.names.size)
        px = CAMERA.project(SE3.inverse_transform(pose, known.positions[sighting["features"][mine]]))
        assert (np.linalg.norm(px - sighting["px"][mine], axis=1) < 2.0).all()
        count += int(mine.sum())
    assert count > 4 * len(truth)
    assert not run.log.lost().any()
