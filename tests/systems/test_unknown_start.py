"""A start without known points: the batch adjustment, when particles are resampled from it, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, Measuring, RoomWorld, simulate_features
from rbpf import MonoSlam
from rbpf.lie import SE3
from rbpf.motion.constant_velocity import velocity_walk
from rbpf.runs.recordings import filter_features as run
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig, StartConfig, VelocityConfig
from rbpf.systems.mono.start.adjustment import SCALE_STD, Linearised, Structure, Window, gathered, minima, optimum
from rbpf.systems.mono.start.unknown import UnknownStart
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, changed, desk, off, rows, without_known
from tests.systems.plane_sequences import path, sequence

LOG = without_known(desk(frames=30))
EARLY = replace(SMALL, start=StartConfig(depth_std_ratio=0.03))
NEVER = replace(SMALL, start=StartConfig(batch_adjust=False))


@pytest.fixture(scope="module")
def plane() -> Run:
    """A textured wall that leans away: flat, so that two shapes and two motions look alike at first."""
    return filter_opened(open_mono(sequence(60), EARLY))


@pytest.mark.slow
def test_a_flat_scene_is_not_bent(plane):
    assert plane.system.start.over
    logs = [
        [filter_opened(open_mono(sequence(60), replace(config, seed=seed))).log for seed in (1, 2)]
        for config in (EARLY, NEVER)
    ]
    resampled, bent = (np.mean([off(log.poses, path(60), log.stamps_ns) for log in each]) for each in logs)
    assert resampled < 0.5 * bent and resampled < 0.012


@pytest.fixture
def adjusted(monkeypatch) -> list[int]:
    """Numbers of frames of each adjustment, those that found too little included."""
    counts, original = [], gathered

    def counted(first, *arguments):
        counts.append(len(first.seen))
        return original(first, *arguments)

    monkeypatch.setattr("rbpf.systems.mono.start.unknown.gathered", counted)
    return counts


@pytest.fixture
def resampled(monkeypatch) -> list[int]:
    """Numbers of frames after which particles were resampled."""
    done, original = [], UnknownStart.after_frame

    def noted(self, *args):
        out = original(self, *args)
        done.extend([] if out[0] is None else [len(out[0].revision.stamps_ns)])
        return out

    monkeypatch.setattr(UnknownStart, "after_frame", noted)
    return done


@pytest.mark.slow
def test_frames_are_adjusted_ever_less_often(adjusted):
    config = StartConfig(first_adjustment=5, growth=1.5, depth_std_ratio=1e-6)
    run(LOG, replace(SMALL, start=config))
    assert adjusted == [5, 8, 12, 18, 27]
    adjusted.clear()
    run(LOG, replace(SMALL, start=replace(config, depth_std_ratio=0.5)))
    assert adjusted[0] == 5 and adjusted[-1] < 27
    adjusted.clear()
    run(LOG, replace(SMALL, start=replace(config, depth_std_ratio=0.05, max_frames=6)))
    assert adjusted == [5, 8, 12]  # where a ratio of 0.14 is more than the 0.08 before, and less than thrice 0.05
    adjusted.clear()
    run(desk(), SMALL)
    run(LOG, NEVER)
    assert adjusted == []


@pytest.mark.slow
@pytest.mark.parametrize("velocity", ["marginal", "joint", "paper"])
def test_every_velocity_goes_on_from_the_path_that_was_drawn(velocity, resampled):
    config = replace(SMALL, velocity=VelocityConfig(velocity), particles=30)
    done = run(LOG, config)
    assert resampled and off(done.log.poses, known(LOG.truth).poses, done.log.stamps_ns) < 0.02


def test_the_map_is_conditioned_on_the_paths(plane):
    """A feature's place in each particle is where that particle's own path saw it."""
    belief = plane.system.filter.belief()
    ids = belief.map.ids
    points = ids[~belief.map.are(ids, plane.system.features.unknown_depth.landmark)].tolist()
    assert len(points) > 10
    means = belief.read(points).mean
    pose = plane.system.filter.particles.state[:, None, :7]
    seen = plane.system.sensor.camera.project(SE3.inverse_transform(pose, means))
    measured = plane.system.measurement.used
    which = [k for k, name in enumerate(points) if name in measured.landmarks]
    z = measured.z[[measured.landmarks.tolist().index(points[k]) for k in which]]
    assert np.median(np.linalg.norm(seen[:, which] - z, axis=-1)) < 1.0


def test_nothing_is_resampled_when_frames_have_too_little_in_common():
    apart = changed(LOG, 3, lambda frame: rows(frame, np.arange(2)))
    np.testing.assert_array_equal(run(apart, NEVER).log.poses, run(apart, SMALL).log.poses)


def test_a_camera_that_was_lost_is_not_adjusted_any_more(adjusted):
    """Black images after the fourth: the start is over when it is lost, and what was kept for it is gone."""
    done = filter_opened(open_mono(sequence(20, lambda t, image: np.zeros_like(image) if 4 <= t < 8 else image), SMALL))
    assert done.log.lost()[6] and done.system.start.over and not adjusted
    assert not any(name.startswith("start/frames") for name in done.system.arrays())


@pytest.mark.slow
def test_a_start_that_shows_nothing_at_first_begins_later(resampled):
    """Logs and videos alike: a lens cap is no loss of a camera that has seen nothing yet."""
    blank = replace(LOG, frames=[frame.take(slice(0)) for frame in LOG.frames[:7]] + LOG.frames[7:])
    assert np.isfinite(run(blank, SMALL).log.poses).all() and resampled
    ramp = np.tile(np.linspace(60, 200, 320).astype(np.uint8), (240, 1))
    lens_cap, lost = lambda t, image: ramp if t < 8 else image, lambda t, image: 0 * image if 0 < t < 5 else image
    for change in (lens_cap, lost):
        resampled.clear()
        done = filter_opened(open_mono(sequence(24, change), SMALL))
        assert done.failure is None and np.isfinite(done.log.poses).all() and bool(resampled) == (change is lens_cap)


def test_a_frame_without_an_image_is_not_what_is_resampled_after(resampled):
    done = filter_opened(open_mono(sequence(12, lambda t, image: None if t == 5 else image), SMALL))
    assert resampled[0] == 7 and done.failure is None


@pytest.mark.slow
def test_where_the_lens_has_no_direction_the_start_does_not_stop(resampled):
    folded = replace(known(LOG.camera), distortion=(-0.25, 0.0, 0.0, 0.0, 0.0))
    frames = list(LOG.frames)
    for t, frame in enumerate(frames[6:10], start=6):
        more = {"z": np.concatenate([frame.z, [[1.0, 1.0]]]), "cov_z": np.concatenate([frame.cov_z, frame.cov_z[:1]])}
        frames[t] = replace(frame, landmarks=np.append(frame.landmarks, 9999), **more)
    done = run(replace(LOG, camera=folded, frames=frames), SMALL)
    assert resampled and np.isfinite(done.log.poses).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_exact_pixels_do_not_begin_with_near_for_far(seed):
    """From six frames an adjustment ends in another minimum: 12 and 14 cm off, where it went on from there."""
    log = simulate_features(RoomWorld(frames=36, laps=0.09, points=400), Measuring(noise_px=0.1), MONO, seed)
    done = run(without_known(log), replace(SMALL, particles=50))
    assert off(done.log.poses, known(log.truth).poses, done.log.stamps_ns) < 0.003


def test_particles_hold_two_shapes_until_one_is_left(monkeypatch):
    """A second minimum half a metre to the side, as likely in the first adjustment and by 10 nats less so in the next."""
    less = iter([0.0, 10.0])

    def two(*arguments):
        best = minima(*arguments)[0]
        path = best.structure.path.copy()
        path[1:, 4] += 0.5
        return [best, replace(best, structure=replace(best.structure, path=path), cost=best.cost + next(less))]

    monkeypatch.setattr("rbpf.systems.mono.start.unknown.minima", two)
    slam, aside = MonoSlam(known(LOG.camera), SMALL), []
    for frame in LOG.frames[:8]:
        slam.take(frame)
        aside.append(np.mean(slam.particle_poses()[:, 4] > 0.25))
    assert aside[4] == 0.0 and aside[5] == 0.5 and aside[7] == 0.0 and next(less, None) is None


# The optimum: its derivatives, its minimum, and what is drawn around it.

LENS = Pinhole(640, 480, 500.0, 510.0, 320.0, 240.0, distortion=(0.05, -0.02, 0.001, 0.0, 0.0))
EXPECTED = MonoConfig()
FRAMES, FEATURES = 7, 14


def seen(truth: Structure, noise_px: float, rng: np.random.Generator) -> tuple[Window, Structure]:
    """All features in every frame; and the truth."""
    count = len(truth.path)
    frame, feature = np.divmod(np.arange(count * FEATURES), FEATURES)
    place = (truth.direction / truth.inverse[:, None])[feature]
    px = LENS.project(SE3.inverse_transform(truth.path[frame], place))
    px += rng.normal(scale=noise_px, size=px.shape)
    return Window(LENS, np.arange(count) * 33_000_000, frame, feature, px, noise_px), truth


def scene(seed: int = 0, noise_px: float = 0.5) -> tuple[Window, Structure]:
    """A camera that goes sideways before features at 0.7 to 2.5 m; the truth, scaled as the optimum holds it."""
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.4, 1.4, FEATURES)
    inverse *= 0.8 / inverse.mean()
    direction = np.append(rng.uniform(-0.4, 0.4, (FEATURES, 2)), np.ones((FEATURES, 1)), axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    moved = np.linspace(0.0, 1.0, FRAMES)[:, None] * [0.05, -0.1, 0.02, 0.15, 0.05, 0.03]
    return seen(Structure(SE3.retract(SE3.identity(), moved), direction, inverse), noise_px, rng)


def test_a_camera_that_seems_to_stand_still_is_found_to_have_moved():
    window, truth = scene()
    still = np.broadcast_to(SE3.identity(), truth.path.shape).copy()
    best = optimum(window, EXPECTED, Structure(still, truth.direction, np.full(FEATURES, 0.8)))  # all equally far
    assert best is not None and best.cost <= Linearised(window, EXPECTED, truth).cost
    assert best.structure.inverse.mean() == pytest.approx(0.8, abs=0.8 * 5.0 * SCALE_STD)
    off = SE3.local(best.structure.path[1:], truth.path[1:]).ravel()
    cov = np.linalg.inv(best.information)[: off.size, : off.size]
    assert off @ np.linalg.solve(cov, off) / off.size < 1.6
    assert np.abs(best.structure.inverse - truth.inverse).max() < 0.1


def walking(seed: int, expected: VelocityConfig, frames: int = 12, noise_px: float = 0.5) -> tuple[Window, Structure]:
    """As `scene`, with a path drawn from the motion that is expected."""
    rng, dt = np.random.default_rng(seed), 0.033
    velocity, path = expected.start_std() * rng.normal(size=6), [SE3.identity()]
    for _ in range(frames - 1):
        walk = velocity_walk(expected.walk_std(), dt) @ rng.normal(size=12)
        path.append(SE3.retract(path[-1], dt * velocity + walk[:6]))
        velocity = velocity + walk[6:]
    return seen(replace(scene(seed)[1], path=np.array(path)), noise_px, rng)


@pytest.mark.slow
def test_errors_are_as_large_as_the_information_says():
    """Normalised squared errors over thirty windows; with differences of velocities as independent or without the loss's
    share of the information the poses' is below 0.85."""
    velocity = VelocityConfig(walk_rad_s=0.5, walk_m_s=0.5, start_rad_s=0.2, start_m_s=0.3)
    of_poses, of_features = [], []
    for seed in range(30):
        window, truth = walking(seed, velocity)
        best = optimum(window, MonoConfig(velocity=velocity), truth)
        assert best is not None
        off = SE3.local(best.structure.path[1:], truth.path[1:]).ravel()
        cov = np.linalg.inv(best.information)[: off.size, : off.size]
        of_poses.append(off @ np.linalg.solve(cov, off) / off.size)
        of_features.append(np.square((best.structure.inverse - truth.inverse) / best.std_inverse()).mean())
    # What is fitted is a little nearer to what was seen than the truth, and gets a little more of the loss's weight.
    assert np.mean(of_poses) == pytest.approx(1.05, abs=0.15)
    assert np.mean(of_features) == pytest.approx(1.05, abs=0.35)


def test_paths_are_drawn_with_the_covariance_of_the_optimum():
    window, truth = scene()
    best = optimum(window, EXPECTED, truth)
    assert best is not None
    paths = best.paths(4000, np.random.default_rng(2))
    assert (paths[:, 0] == truth.path[0]).all()
    drawn = SE3.local(best.structure.path[-1], paths[:, -1])
    last = slice(6 * (FRAMES - 2), 6 * (FRAMES - 1))
    cov = np.linalg.inv(best.information)
    std = np.sqrt(np.diag(cov)[last])
    np.testing.assert_allclose(drawn.std(axis=0), std, rtol=0.06)
    np.testing.assert_allclose(np.corrcoef(drawn.T), (cov[last, last] / std / std[:, None]), atol=0.06)
    features = cov.shape[0] - 3 * FEATURES + 2 + 3 * np.arange(FEATURES)
    np.testing.assert_allclose(best.std_inverse(), np.sqrt(np.diag(cov)[features]), rtol=1e-6)
