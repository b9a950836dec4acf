"""`MonoSlam.track`: one frame at a time, what it waits for and revises, bounded memory, exchanged parts."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.soak import held_bytes
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.readers import ImageFrame
from rbpf.systems.mono.active_search import MotionFit, OutlierGate, RobustMotionGate
from rbpf.systems.mono.config import MonoConfig, StartConfig
from rbpf.systems.mono.feature_sensor import InverseDepthRays
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.system import FrameLog, Tracked, TrackingState
from tests.exactness.models import known
from tests.systems.mono_logs import desk
from tests.systems.plane_sequences import CAMERA, known_points, made_up_map, sequence

CONFIG = MonoConfig(particles=5)
KNOWN = known_points()
DARK = np.zeros((240, 320), dtype=np.uint8)
LOG = desk(2, frames=8)


def images(frames: int, change=lambda t, image: image) -> list[ImageFrame]:
    return list(sequence(frames, change).frames())


def tracked_all(slam: MonoSlam, frames: list) -> list[Tracked]:
    return [slam.take(frame) for frame in frames]


def test_images_from_anywhere_give_the_bytes_of_a_run_over_a_recording():
    """Though a driver writes all of them into the same memory."""
    run = filter_opened(open_mono(sequence(10), CONFIG))
    slam, buffer = MonoSlam(CAMERA, CONFIG), np.empty_like(DARK)
    log = FrameLog(slam)
    for frame in images(10):
        buffer[:] = frame.image
        log.append(slam.track(buffer, frame.stamp_ns), 0.0)
    assert log.poses.tobytes() == run.log.poses.tobytes() and log.covs.tobytes() == run.log.covs.tobytes()
    for name in ("searched", "found", "ess", "log_evidence", "nis"):
        np.testing.assert_array_equal(log[name], run.log[name])


def test_a_start_without_known_points_is_revised_and_says_so():
    slam = MonoSlam(CAMERA, replace(CONFIG, start=StartConfig(depth_std_ratio=0.03)))
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


@pytest.mark.slow
def test_memory_is_that_of_the_map():
    """To and fro before a wall: after the map is there, frames leave nothing behind."""
    slam = MonoSlam(CAMERA, replace(CONFIG, lag=10))
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
    whole, last = (
        filter_opened(open_mono(sequence(12), replace(CONFIG, lag=lag, map="particles"))) for lag in (None, 5)
    )
    np.testing.assert_array_equal(last.log.poses, whole.log.poses)
    assert whole.system.particle_paths().shape == (12, 5, 7)
    np.testing.assert_array_equal(last.system.particle_paths(), whole.system.particle_paths()[-5:])
    np.testing.assert_array_equal(last.system.filter.history.stamps_ns, whole.log.stamps_ns[-5:])


class Incredulous(OutlierGate):
    """Believes no match."""

    def fit(self, nu, jac, cov, factor, trusted) -> MotionFit:
        return RobustMotionGate().fit(nu, jac, cov, factor, trusted)._replace(squared=np.full(len(nu), np.inf))


def test_a_gate_of_ones_own():
    tracked = tracked_all(MonoSlam(CAMERA, CONFIG, KNOWN, gate=Incredulous()), images(6))
    assert tracked[3].values["searched"] > 0 == tracked[3].values["found"]
    assert tracked[-1].state is TrackingState.LOST


def test_a_kind_of_feature_of_ones_own():
    near = InverseDepthRays(CAMERA, replace(CONFIG.inverse_depth, mean_per_m=2.0, from_scene_depth=False))
    for kind, rho in ((None, CONFIG.inverse_depth.mean_per_m), (near, 2.0)):
        config = replace(CONFIG, start=StartConfig(batch_adjust=False))
        slam = MonoSlam(CAMERA, config, unknown_depth=kind)
        slam.take(images(1)[0])
        belief = slam.filter.belief()
        assert (belief.read(belief.map.ids).mean[..., 2] == rho).all() and slam.map().is_ray().all()


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
