"""A start without known points: when the particles are drawn anew, from what, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.mono.config import MonoConfig, StartConfig, VelocityConfig
from rbpf.systems.mono.run import run
from rbpf.systems.mono.unknown_start import TORN, UnknownStart, between
from rbpf.systems.mono.video import VideoRun, run_images
from rbpf.validation.metrics.accuracy import ate
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, changed, desk, rows, without_known
from tests.systems.plane_sequences import path, sequence

LOG = without_known(desk(frames=30))
NEVER = replace(SMALL, start=StartConfig(batch_adjust=False))
SECOND = 1_000_000_000


def off(done_path: np.ndarray, truth: np.ndarray, stamps_ns: np.ndarray) -> float:
    """Error after an alignment with scale, m."""
    return ate(Trajectory(stamps_ns, done_path), Trajectory(stamps_ns, truth), "similarity").rmse


def of_plane(done: VideoRun) -> float:
    return off(done.world_from_camera, path(done.stamps_ns.size), done.stamps_ns)


@pytest.fixture(scope="module")
def plane() -> VideoRun:
    """A textured wall that leans away: flat, so that two shapes and two motions look alike at first."""
    return run_images(sequence(60), SMALL)


@pytest.mark.slow
def test_a_flat_scene_is_not_bent(plane):
    assert plane.start.over
    drawn, bent = (
        np.mean([of_plane(run_images(sequence(60), replace(config, seed=seed))) for seed in (1, 2)])
        for config in (SMALL, NEVER)
    )
    assert drawn < 0.5 * bent and drawn < 0.012


def test_the_world_starts_at_the_first_camera(plane):
    np.testing.assert_allclose(plane.world_from_camera[0], SE3.identity(), atol=1e-12)
    assert (plane.filter.history.paths()[0] == SE3.identity()).all()
    assert plane.start.arrays()["start/names"].size > 10
    assert plane.filter.steps == 60 and plane.filter.history.stamps_ns.tolist() == plane.stamps_ns.tolist()


def test_frames_are_adjusted_ever_less_often(monkeypatch):
    counts = []
    redrawn = UnknownStart.redrawn

    def counted(self, filter_, features, frames, path):
        counts.append(len(frames))
        return redrawn(self, filter_, features, frames, path)

    monkeypatch.setattr(UnknownStart, "redrawn", counted)
    run(LOG, replace(SMALL, start=StartConfig(first_adjustment=5, growth=1.5, depth_std_ratio=1e-6)))
    assert counts == [5, 8, 12, 18, 27]
    counts.clear()
    run(LOG, replace(SMALL, start=StartConfig(first_adjustment=5, growth=1.5, depth_std_ratio=0.5)))
    assert counts[0] == 5 and counts[-1] < 27
    counts.clear()
    run(desk(), SMALL)
    run(LOG, NEVER)
    assert counts == []


@pytest.fixture
def drawn(monkeypatch) -> list[int]:
    """Numbers of frames after which particles were drawn anew."""
    done, redrawn = [], UnknownStart.redrawn

    def noted(self, filter_, features, frames, path):
        out = redrawn(self, filter_, features, frames, path)
        done.extend([] if out is None else [len(frames)])
        return out

    monkeypatch.setattr(UnknownStart, "redrawn", noted)
    return done


@pytest.mark.parametrize("velocity", ["marginal", "joint", "paper"])
def test_every_velocity_goes_on_from_the_path_that_was_drawn(velocity, drawn):
    config = replace(SMALL, velocity=VelocityConfig(velocity), particles=30)
    done = run(LOG, config)
    assert drawn and off(done.world_from_camera, known(LOG.truth).world_from_camera, done.stamps_ns) < 0.02


def test_few_of_the_frames_do_as_well(drawn):
    """Half of them at most take part; those between are on the way, and measure nothing."""
    config = replace(SMALL, start=StartConfig(max_frames=8))
    done = run(LOG, config)
    assert drawn and off(done.world_from_camera, known(LOG.truth).world_from_camera, done.stamps_ns) < 0.02


def test_the_map_is_conditioned_on_the_paths(plane):
    """A feature's place in each particle is where that particle's own path saw it."""
    belief = plane.filter.belief()
    points = [
        k
        for k in belief.map.ids.tolist()
        if belief.map.are(np.array([k]), plane.sensor.features.inverse_depth)[0] == 0
    ]
    assert len(points) > 10
    means = belief.read(points).mean
    pose = plane.filter.particles.state[:, None, :7]
    seen = plane.sensor.camera.project(SE3.inverse_transform(pose, means))
    names = [belief.catalogue[k] for k in points]
    measured = plane.sensor.measured
    which = [k for k, name in enumerate(names) if name in measured.landmarks]
    z = measured.z[[measured.landmarks.tolist().index(names[k]) for k in which]]
    assert np.median(np.linalg.norm(seen[:, which] - z, axis=-1)) < 1.0


def test_nothing_is_drawn_when_frames_have_too_little_in_common():
    apart = changed(LOG, 3, lambda frame: rows(frame, np.arange(2)))
    assert_the_same(apart, NEVER, SMALL)


def test_frames_without_features_are_passed_over(drawn):
    empty = changed(
        changed(LOG, 3, lambda frame: rows(frame, np.arange(0))), 4, lambda frame: rows(frame, np.arange(0))
    )
    done = run(empty, SMALL)
    assert drawn and off(done.world_from_camera, known(LOG.truth).world_from_camera, done.stamps_ns) < 0.02


def assert_the_same(log: FeatureLog, *configs: MonoConfig) -> None:
    paths = [run(log, config).world_from_camera for config in configs]
    np.testing.assert_array_equal(paths[0], paths[1])


def test_a_camera_that_was_lost_is_not_drawn_anew():
    start = UnknownStart(SMALL, needed=True)
    assert start.due(6, lost=False) and not start.due(6, lost=True) and not start.due(50, lost=False)


def test_a_torn_start_is_told(monkeypatch):
    monkeypatch.setattr("rbpf.systems.mono.unknown_start.SHARED", 1000)
    done = run_images(sequence(8), SMALL)
    assert done.start.over and done.problems == [f"frame 5: {TORN}"]


@pytest.mark.slow
def test_a_resumed_start_ends_in_the_same_bytes(tmp_path):
    """Broken off between two adjustments."""
    file = tmp_path / "checkpoint.npz"
    whole = run_images(sequence(24), SMALL)

    def stop(t, frame, run):
        if t == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_images(sequence(24), SMALL, None, stop, file)
    assert file.exists()
    resumed = run_images(sequence(24), SMALL, None, None, file, resume=True)
    np.testing.assert_array_equal(whole.world_from_camera, resumed.world_from_camera)
    np.testing.assert_array_equal(whole.cov, resumed.cov)


def test_poses_between_are_on_the_way():
    ends = SE3.retract(
        SE3.identity(), np.array([[0.0] * 6, [0.0, 0.0, 0.4, 1.0, 0.0, 0.0], [0.2, 0, 0, 0, 0, 0]])
    )
    times = np.array([0, 10, 30])
    found = between(times, ends[None], np.array([-5, 0, 5, 10, 20, 30, 40]))
    assert found.shape == (7, 1, 7)
    np.testing.assert_allclose(found[[0, 1, 3, 5, 6], 0], ends[[0, 0, 1, 2, 2]], atol=1e-12)
    half = SE3.log(SE3.between(ends[0], found[2, 0]))
    np.testing.assert_allclose(half, [0.0, 0.0, 0.2, 0.5, 0.0, 0.0], atol=1e-12)
    both = SE3.log(SE3.between(found[3, 0], found[4, 0])), SE3.log(SE3.between(found[4, 0], found[5, 0]))
    np.testing.assert_allclose(both[0], both[1], atol=1e-9)


def test_a_start_that_shows_nothing_at_first_begins_later(drawn):
    """Logs and videos alike: a lens cap is no loss of a camera that has seen nothing yet."""
    blank = LOG
    for t in range(7):
        blank = changed(blank, t, lambda frame: rows(frame, np.arange(0)))
    assert np.isfinite(run(blank, SMALL).world_from_camera).all() and drawn
    drawn.clear()
    ramp = np.tile(np.linspace(60, 200, 320).astype(np.uint8), (240, 1))
    done = run_images(sequence(24, lambda t, image: ramp if t < 8 else image), SMALL)
    assert done.failure is None and np.isfinite(done.world_from_camera).all() and drawn
    drawn.clear()
    done = run_images(sequence(24, lambda t, image: np.zeros_like(image) if 0 < t < 5 else image), SMALL)
    assert done.failure is None


def test_a_frame_without_an_image_is_not_what_is_drawn_after(drawn):
    done = run_images(sequence(12, lambda t, image: None if t == 5 else image), SMALL)
    assert drawn[0] == 7 and done.failure is None


def test_what_the_new_map_has_not_is_not_looked_for(drawn):
    """Features that were started in frames that took no part."""
    done = run_images(sequence(40), replace(SMALL, start=StartConfig(max_frames=5, depth_std_ratio=1e-6)))
    table = done.sensor.table
    held = set(done.filter.belief().catalogue.values())
    assert drawn and set(np.flatnonzero(table.alive).tolist()) <= held


def test_where_the_lens_has_no_direction_the_start_does_not_stop(drawn):
    folded = replace(known(LOG.camera), distortion=(-0.25, 0.0, 0.0, 0.0, 0.0))
    frames = list(LOG.frames)
    for t in (6, 7, 8, 9):
        frame = frames[t]
        cov = np.concatenate([frame.cov_z, frame.cov_z[:1]])
        z = np.concatenate([frame.z, [[1.0, 1.0]]])
        frames[t] = replace(frame, landmarks=np.append(frame.landmarks, 9999), z=z, cov_z=cov)
    done = run(replace(LOG, camera=folded, frames=frames), SMALL)
    assert drawn and np.isfinite(done.world_from_camera).all()


@pytest.mark.parametrize(
    "wrong", [{"first_adjustment": 2}, {"max_frames": 0}, {"growth": 1.0}, {"growth": float("nan")}]
)
def test_settings_that_make_no_sense(wrong):
    with pytest.raises(InputError, match=f"start.{next(iter(wrong))}"):
        StartConfig(**wrong)


@pytest.mark.parametrize(
    ("name", "damaged"),
    [
        ("start/progress", np.zeros(3, dtype=np.int64)),
        ("start/path", np.zeros((2, 7))),
        ("start/inverse", np.zeros(1)),
        ("start/names", np.zeros(2)),
    ],
)
def test_a_damaged_checkpoint_is_refused(plane, name, damaged):
    with pytest.raises(InputError, match=name):
        UnknownStart(SMALL, needed=True).restore(plane.start.arrays() | {name: damaged})
