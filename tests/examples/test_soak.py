"""Filters that run for ever: streams without an end, and memory that can be seen to grow where something is kept."""

from itertools import islice

import numpy as np
import pytest

from examples.studies.soak import Forgetting, camera_steps, robot_steps, soak
from examples.studies.streams import CameraStream, RobotStream, Turnover
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig

QUICK = Turnover(points=40, measurements=8, renewal=0.01)


@pytest.mark.parametrize("kind", [CameraStream, RobotStream])
def test_the_same_seed_gives_the_same_stream(kind):
    one, other, third = (list(islice(kind(QUICK, seed).frames(), 20)) for seed in (3, 3, 4))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.frame.z, b.frame.z)
        np.testing.assert_array_equal(a.frame.landmarks, b.frame.landmarks)
    assert any(
        a.frame.z.shape != b.frame.z.shape or (a.frame.z != b.frame.z).any() for a, b in zip(one, third, strict=True)
    )


def test_forgetting():
    """What has not been seen for three frames is dropped; what is seen is not."""

    stream = RobotStream(Turnover(points=30, measurements=30, renewal=0.0), 0)
    filter_, step = robot_steps(stream, RangeBearingConfig(particles=3, lag=5), forget=3)
    window: list[set[int]] = []
    ever: set[int] = set()
    for t, (frame, _) in enumerate(islice(stream.frames(), 200)):
        step(frame, t)
        window = [*window[-3:], set(frame.landmarks.tolist())]
        ever |= window[-1]
        held = set(filter_.belief().map.ids.tolist())
        assert held == set().union(*window)
    assert len(ever) > 2 * len(held)
    assert isinstance(filter_.sensors[0], Forgetting) and filter_.sensors[0].frame == 200


@pytest.mark.slow
def test_a_long_run():
    """Neither memory nor error grows, nor the time by half."""
    lag, steps = 50, 2000
    stream = RobotStream(Turnover(renewal=0.006), 0)
    filter_, step = robot_steps(stream, RangeBearingConfig(particles=10, lag=lag), forget=steps // 20)
    windows = list(soak(stream, filter_, step, steps, steps // 20))
    settled = windows[4:]
    held, times, errors = (
        np.array([getattr(window, name) for window in settled]) for name in ("held_kb", "ms_per_frame", "error_m")
    )
    assert windows[-1].started > 4 * windows[-1].landmarks
    assert held[-4:].mean() < 1.15 * held[:4].mean()
    assert max(window.states for window in settled) <= lag * 10
    assert np.median(times[-4:]) < 1.5 * np.median(times[:4])
    assert errors[-4:].max() < 2.0 * errors[:4].max() and errors.max() < 0.5


@pytest.mark.slow
def test_a_long_monocular_run():
    stream = CameraStream(Turnover(renewal=0.004), 0)
    filter_, step = camera_steps(stream, MonoConfig(particles=10, lag=50), forget=150)
    windows = list(soak(stream, filter_, step, 1200, 150))
    held = np.array([window.held_kb for window in windows[2:]])
    assert windows[-1].started > 2 * windows[-1].landmarks
    assert held.max() < 1.1 * held.min()
    assert max(window.states for window in windows) <= 50 * 10
    assert max(window.error_m for window in windows[2:]) < 0.1
