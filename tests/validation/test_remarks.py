"""What is said of a run before its figures: that nothing was measured, or that nothing moved."""

from dataclasses import dataclass

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.runs.folder import _in_the_image, remarks
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Source
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.finish import finish_run

pytestmark = pytest.mark.usefixtures("plain_pictures")

CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
RNG = np.random.default_rng(0)
NOISE = [RNG.integers(0, 256, (240, 320), dtype=np.uint8) for _ in range(2)]
WALL = RNG.integers(0, 256, (30, 40)).repeat(8, axis=0).repeat(8, axis=1).astype(np.uint8)
BLACK = np.zeros((240, 320), dtype=np.uint8)
USELESS = {"black": (BLACK, BLACK), "noise": (NOISE[0], NOISE[1]), "one missing": (WALL, None)}


@dataclass(frozen=True)
class Repeated(Source):
    """The same pair again and again."""

    pair: tuple[np.ndarray, np.ndarray | None]
    count: int

    def frames(self, start):
        return iter([ImageFrame(t * 100_000_000, *self.pair) for t in range(start, self.count)])


def run_over(pair, count=4):
    stamps = np.arange(count) * 100_000_000
    sequence = ImageSequence("pair", CAMERA, stamps, None, 0.12, Repeated(pair, count))
    return filter_opened(open_pairs(sequence, StereoConfig(particles=8)))


@pytest.mark.parametrize("pair", USELESS.values(), ids=USELESS)
def test_a_recording_of_which_no_pair_can_be_used_is_finished_and_says_so(pair, tmp_path):
    entries = finish_run(run_over(pair), tmp_path, {"recording": "pair"}, video=False)
    assert entries["sentences"][0].startswith("None of the 4 pairs could be measured")
    assert "no two frames share" in entries["batch_problem"] in entries["sentences"][-1]
    assert "None of the 4 pairs" in (tmp_path / "report.html").read_text()


def test_a_still_camera_is_said_to_be_still():
    """3.3 m before a wall; not of one that ends 50 mm from where it began, more than a hundredth of that."""
    run = run_over((WALL, np.roll(WALL, -9, axis=1)))
    assert run.log["measured"].all()
    (said,) = remarks(run)
    assert said.startswith("It stood still, or nearly: the path stays within 0") and "depth" not in said
    run.log._path["poses"][-1] = run.log.poses[-1] + [0, 0, 0, 0, 0, 0, 0.05]
    assert remarks(run) == []


@pytest.mark.parametrize(("of_camera", "told"), [("still", True), ("turns", True), ("shifted", False)])
def test_what_stays_in_the_image_while_other_things_move_is_no_world(of_camera, told):
    """Six of twelve; a camera that is shifted without turning may see them far away."""
    ids, apart = np.arange(12), 20.0 * np.arange(24.0).reshape(12, 2) % 230.0
    moving = (ids % 2)[:, None]
    frames = [FeatureFrame(t, ids, apart + t * moving * [1.0, 0.0], np.tile(np.eye(2), (12, 1, 1))) for t in range(40)]
    poses = SE3.exp(np.arange(40)[:, None] * np.array([0.0, 0.001 * (of_camera == "turns"), 0.0, 0.1, 0.0, 0.0]))
    assert len(_in_the_image(FeatureLog("dirt", CAMERA, frames), poses, of_camera == "still")) == told
