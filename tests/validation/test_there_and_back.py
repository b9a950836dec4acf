"""Recordings played forward and then backward."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers.images import open_stereo
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.features import STEREO, Measuring, simulate_features
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.lab_points import LabWorld
from rbpf.validation.simulation.textured_lab import LabDrive, TexturedLab
from rbpf.validation.there_and_back import log_there_and_back, pairs_there_and_back


def test_pixels_come_again_in_reverse():
    world = LabWorld(LabDrive(frames=4, every=4), points=2000)
    log = simulate_features(world, Measuring(known=0), STEREO, seed=0)
    both = log_there_and_back(log)
    assert [frame.stamp_ns for frame in both.frames] == list(range(7))
    for t, row in enumerate([0, 1, 2, 3, 2, 1, 0]):
        np.testing.assert_array_equal(both.frames[t].landmarks, log.frames[row].landmarks)
        np.testing.assert_array_equal(both.frames[t].z, log.frames[row].z)
        np.testing.assert_array_equal(both.truth.world_from_camera[t], log.truth.world_from_camera[row])
    np.testing.assert_array_equal(both.truth.stamps_ns, np.arange(7))
    assert log_there_and_back(replace(log, truth=None)).truth is None


def test_pairs_come_again_in_reverse(tmp_path):
    rig = RectifiedStereo(Pinhole(80, 60, 62.5, 62.5, 39.5, 29.5), 0.12)
    world, imaging = TexturedLab(LabDrive(frames=3), texel_m=0.05), Imaging(known=0)
    simulate_images(world, imaging, rig, tmp_path / "lab", seed=0)
    sequence = open_stereo(tmp_path / "lab")
    before, both = list(sequence.frames()), pairs_there_and_back(sequence)
    after = list(both.frames())
    step = int(np.median(np.diff(sequence.stamps_ns)))
    assert [frame.stamp_ns for frame in after] == [t * step for t in range(5)]
    for frame, row in zip(after, [0, 1, 2, 1, 0], strict=True):
        np.testing.assert_array_equal(frame.image, before[row].image)
        np.testing.assert_array_equal(frame.right, before[row].right)
    poses = both.truth.world_from_camera
    np.testing.assert_array_equal(poses, poses[::-1])
    assert not np.array_equal(poses[0], poses[2])
    assert len(list(both.frames(3))) == 2
    with pytest.raises(InputError, match="ground truth"):
        pairs_there_and_back(replace(sequence, pair=replace(sequence.pair, truth=None)))
