"""`MonoSlam.track`: one frame at a time, survived bad frames, checkpoints after any frame, bounded memory, exchanged parts."""

import gc
from dataclasses import replace
from types import FunctionType, MethodType, ModuleType

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.frame_log import FrameLog
from rbpf.runs.recordings import filter_images
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.readers import ImageFrame
from rbpf.systems.mono.active_search import MotionFit, OutlierGate, RobustMotionGate
from rbpf.systems.mono.config import MonoConfig, StartConfig
from rbpf.systems.mono.feature_sensor import InverseDepthRays
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.system import Tracked, TrackingState
from tests.core.worlds import content, same
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, desk, without_known
from tests.systems.plane_sequences import CAMERA, known_points, made_up_map, path, sequence, texture, view

CONFIG = MonoConfig(particles=5)
KNOWN = known_points()
DARK = np.zeros((240, 320), dtype=np.uint8)
LOG = desk(2, frames=8)


def images(frames: int, change=lambda t, image: image) -> list[ImageFrame]:
    return list(sequence(frames, change).frames())


def tracked_all(slam: MonoSlam, frames: list) -> list[Tracked]:
    return [slam.take(frame) for frame in frames]


def blinking(t, image):
    """Frozen first, then dark, then as if nothing had been."""
    if 2 <= t < 9:
        return view(texture(), path(3)[1])
    return DARK if 9 <= t < 14 else image


CASES = {
    "known points": (lambda: MonoSlam(CAMERA, CONFIG, KNOWN), lambda: images(8)),
    "separate points": (lambda: MonoSlam(CAMERA, replace(CONFIG, known="points"), KNOWN), lambda: images(8)),
    "nothing known": (lambda: MonoSlam(CAMERA, CONFIG), lambda: images(12)),
    "lost and found": (lambda: MonoSlam(CAMERA, CONFIG, KNOWN), lambda: images(18, blinking)),
    "waiting": (lambda: MonoSlam(CAMERA, CONFIG, KNOWN), lambda: images(4, lambda t, i: None if t < 2 else i)),
    "named features": (lambda: MonoSlam(LOG.camera, SMALL, LOG.known), lambda: LOG.frames),
    "named, nothing known": (
        lambda: MonoSlam(LOG.camera, replace(SMALL, start=StartConfig(first_adjustment=4))),
        lambda: without_known(LOG).frames,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_checkpoint_after_any_frame_goes_on_with_the_same_bytes(case, tmp_path):
    make, frames = CASES[case][0], CASES[case][1]()
    slam, whole = make(), []
    for t, frame in enumerate(frames):
        whole.append(slam.take(frame))
        slam.save(tmp_path / f"{t}.npz", {"of the caller": np.array(t)})
    assert (case != "lost and found") or any(each.state is TrackingState.LOST for each in whole)
    assert (case != "nothing known") or sum(each.revision is not None for each in whole) > 1
    for t in range(len(frames)):
        again = make()
        extra = again.load(tmp_path / f"{t}.npz")
        assert extra["of the caller"] == t
        for mine, theirs in zip(tracked_all(again, frames[t + 1 :]), whole[t + 1 :], strict=True):
            assert mine.pose.tobytes() == theirs.pose.tobytes() and mine.cov.tobytes() == theirs.cov.tobytes()
            assert (mine.state, mine.messages) == (theirs.state, theirs.messages)
            assert (mine.revision is None) == (theirs.revision is None)
            assert all(mine.observed[name].tobytes() == theirs.observed[name].tobytes() for name in mine.observed)
        assert same(content(again.filter), content(slam.filter))
        mine, theirs = again.arrays(), slam.arrays()
        assert mine.keys() == theirs.keys()
        assert all(np.asarray(mine[name]).tobytes() == np.asarray(theirs[name]).tobytes() for name in mine)


def test_images_from_anywhere_give_the_bytes_of_a_run_over_a_recording():
    """Though a driver writes all of them into the same memory."""
    run = filter_images(sequence(10), CONFIG)
    slam, buffer = MonoSlam(CAMERA, CONFIG), np.empty_like(DARK)
    log = FrameLog.of(slam)
    for frame in images(10):
        buffer[:] = frame.image
        tracked = slam.track(buffer, frame.stamp_ns)
        assert tracked.values.keys() == {column.name for column in slam.columns}
        assert tracked.observed.keys() == {ragged.name for ragged in slam.observed}
        log.append(tracked, 0.0)
    assert log.poses.tobytes() == run.log.poses.tobytes()
    assert log.covs.tobytes() == run.log.covs.tobytes()
    for name in ("searched", "found", "ess", "log_evidence", "nis"):
        np.testing.assert_array_equal(log[name], run.log[name])


def test_a_start_without_known_points_is_revised_and_says_so():
    slam = MonoSlam(CAMERA, CONFIG)
    frames = images(40)
    tracked = tracked_all(slam, frames)
    assert slam.start.over
    revised = [t for t, each in enumerate(tracked) if each.revision is not None]
    assert revised[0] == CONFIG.start.first_adjustment - 1 and len(revised) > 1
    for t in revised:
        revision = tracked[t].revision
        assert revision.stamps_ns.tolist() == [frame.stamp_ns for frame in frames[: t + 1]]
        np.testing.assert_allclose(revision.poses[0], SE3.identity(), atol=1e-12)
        np.testing.assert_array_equal(revision.poses[-1], tracked[t].pose)
        assert revision.covs.shape == (t + 1, 6, 6)
    states = [each.state for each in tracked]
    assert set(states[: revised[-1]]) == {TrackingState.INITIALISING}
    assert set(states[revised[-1] :]) == {TrackingState.TRACKED}


BAD = {
    "none": (None, "there is no image"),
    "black": (DARK, "the image shows nothing"),
    "smaller": (DARK[:100, :100], "expected 320x240"),
    "larger": (np.pad(DARK, 50), "expected 320x240"),
    "colour": (np.zeros((240, 320, 3), dtype=np.uint8), "expected 320x240"),
    "empty": (DARK[:0], "expected 320x240"),
    "no number": (DARK * np.nan, "expected 320x240"),
    "no array": ("image", "expected 320x240"),
}


@pytest.mark.parametrize("start", ["known points", "nothing known"])
def test_bad_images_are_survived_and_said(start):
    """One of each kind, two good ones between them."""
    slam = MonoSlam(CAMERA, CONFIG, KNOWN if start == "known points" else None)
    bad = dict(zip(range(4, 4 + 3 * len(BAD), 3), BAD.values(), strict=True))
    tracked = tracked_all(slam, images(5 + 3 * len(BAD), lambda t, good: bad[t][0] if t in bad else good))
    for t, each in enumerate(tracked):
        if t in bad:
            assert each.state is TrackingState.PREDICTED
            assert len(each.messages) == 1 and bad[t][1] in each.messages[0]
            assert each.values["found"] == 0 and each.observed["features"].size == 0
        else:
            assert each.state in (TrackingState.TRACKED, TrackingState.INITIALISING) and not each.messages
            assert t == 0 or each.values["found"] > 10


def test_stamps_that_stand_still_or_run_backwards():
    """No time passes between equal stamps; one before the last changes nothing."""
    slam, frames = MonoSlam(CAMERA, CONFIG, KNOWN), images(6)
    tracked_all(slam, frames[:3])
    twice = slam.track(frames[3].image, frames[2].stamp_ns)
    assert twice.state is TrackingState.TRACKED and np.isfinite(twice.cov).all()
    before = slam.arrays(), content(slam.filter)
    with pytest.raises(InputError, match="time runs backwards"):
        slam.track(frames[4].image, frames[1].stamp_ns)
    assert same(before[1], content(slam.filter))
    assert all(np.array_equal(slam.arrays()[name], array) for name, array in before[0].items())
    assert slam.take(frames[4]).values["found"] > 10


def test_known_points_wait_for_the_first_image():
    slam = MonoSlam(CAMERA, CONFIG, KNOWN)
    frames = images(6, lambda t, image: (None, DARK)[t] if t < 2 else image)
    tracked = tracked_all(slam, frames)
    for each in tracked[:2]:
        assert each.state is TrackingState.INITIALISING and "first image" in each.messages[-1]
        assert np.sqrt(np.diag(each.cov)).tolist() == [0.5] * 3 + [1.0] * 3
    assert tracked[2].state is TrackingState.TRACKED and not tracked[2].messages
    as_usual = tracked_all(MonoSlam(CAMERA, CONFIG, KNOWN), frames[2:])
    assert tracked[-1].pose.tobytes() == as_usual[-1].pose.tobytes()


def held_bytes(root: object) -> int:
    """Of all arrays that an object refers to, directly or not."""
    seen, waiting, total = set(), [root], 0
    while waiting:
        item = waiting.pop()
        while isinstance(item, np.ndarray) and item.base is not None:
            item = item.base
        if id(item) in seen or isinstance(item, type | ModuleType | FunctionType | MethodType):
            continue
        seen.add(id(item))
        total += item.nbytes if isinstance(item, np.ndarray) else 0
        waiting.extend(gc.get_referents(item))
    return total


@pytest.mark.slow
@pytest.mark.parametrize("start", ["known points", "nothing known"])
def test_memory_is_that_of_the_map(start):
    """To and fro before a wall: after the map is there, frames leave nothing behind."""
    slam = MonoSlam(CAMERA, replace(CONFIG, lag=10), KNOWN if start == "known points" else None)
    frames, turn, held, features = images(60), 60 * 33_333_333, [], []
    for k in range(4):
        for t, frame in enumerate(frames if k % 2 == 0 else reversed(frames)):
            slam.track(frame.image, k * turn + t * 33_333_333)
        held.append(held_bytes(slam))
        features.append(len(slam.sensor.table))
    assert slam.start.over and not slam.sensor.lost
    patches = 2.0 * slam.sensor.table.first_patch[0].nbytes  # a table that is full doubles its room
    assert held[3] - held[1] <= 2.0 * (features[3] - features[0] + 64) * (patches + 500.0)


def test_a_lag_keeps_the_last_frames_and_changes_no_estimate():
    whole, last = (filter_images(sequence(12), replace(CONFIG, lag=lag)) for lag in (None, 5))
    np.testing.assert_array_equal(last.log.poses, whole.log.poses)
    assert whole.system.particle_paths().shape == (12, 5, 7)
    np.testing.assert_array_equal(last.system.particle_paths(), whole.system.particle_paths()[-5:])
    np.testing.assert_array_equal(last.system.filter.history.stamps_ns, whole.log.stamps_ns[-5:])


class Cautious(OutlierGate):
    """Believes nothing from the fourth frame on."""

    def __init__(self) -> None:
        self.calls = 0

    def fit(self, nu, jac, cov, factor, trusted) -> MotionFit:
        self.calls += 1
        found = RobustMotionGate().fit(nu, jac, cov, factor, trusted)
        return found if self.calls < 4 else found._replace(squared=np.full(len(nu), np.inf))


def test_a_gate_of_ones_own():
    tracked = tracked_all(MonoSlam(CAMERA, CONFIG, KNOWN, gate=Cautious()), images(8))
    assert tracked[3].values["found"] > 10 and tracked[4].values["found"] == 0
    assert tracked[-1].state is TrackingState.LOST


def test_a_kind_of_feature_of_ones_own():
    near = InverseDepthRays(CAMERA, replace(CONFIG.inverse_depth, mean_per_m=2.0, from_scene_depth=False))
    for kind, rho in ((None, CONFIG.inverse_depth.mean_per_m), (near, 2.0)):
        config = replace(CONFIG, start=StartConfig(batch_adjust=False))
        slam = MonoSlam(CAMERA, config, unknown_depth=kind)
        slam.take(images(1)[0])
        belief = slam.filter.belief()
        assert (belief.read(belief.map.ids).mean[..., 2] == rho).all()
        assert slam.map().is_ray().all()


def test_what_a_system_refuses():
    pixels, names = known_points(), known(LOG.known)
    with pytest.raises(InputError, match="leave out known points"):
        MonoSlam(CAMERA, CONFIG, pixels, made_up_map())
    with pytest.raises(InputError, match="images need KnownPixels"):
        MonoSlam(CAMERA, CONFIG, names).take(images(1)[0])
    with pytest.raises(InputError, match="named features need KnownPoints"):
        MonoSlam(CAMERA, CONFIG, pixels).take(LOG.frames[0])
    slam = MonoSlam(CAMERA, CONFIG)
    slam.take(images(1)[0])
    nothing = FeatureFrame(10**9, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    with pytest.raises(InputError, match="images or named features, not both"):
        slam.take(nothing)
