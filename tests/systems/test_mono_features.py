"""Named features through the monocular system: starts, rays and points, equal bytes, what a frame may hold."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.point_worlds import STEREO, DeskWorld, Measuring, simulate_features
from rbpf.core.filter import Filter
from rbpf.core.models import Part
from rbpf.core.particles import Prior
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.point import Point
from rbpf.runs.recordings import filter_features as run
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraRay, EpipolarRay
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig, VelocityConfig
from rbpf.systems.mono.slam import MonoSlam
from tests.core.worlds import content, same
from tests.exactness.models import known
from tests.systems.mono_logs import SMALL, changed, desk, errors, nees, rows, without_known

LOG, FIRST = desk(2, frames=10), desk()
every_mode = pytest.mark.parametrize("mode", ["frame", "points"])
SETTINGS = [
    SMALL,
    replace(SMALL, known="points"),
    replace(SMALL, velocity=VelocityConfig("joint"), inverse_depth=InverseDepthConfig("epipolar")),
    replace(SMALL, velocity=VelocityConfig("paper"), inverse_depth=InverseDepthConfig("off")),
]
every_setting = pytest.mark.parametrize("config", SETTINGS, ids=["default", "points", "joint", "paper"])


def kinds(filter_: Filter) -> dict[int, type]:
    """Parametrisation of each landmark, by its name."""
    held = filter_.belief().map
    return {i: type(held.landmark_of(i)) for i in held.ids.tolist()}


@every_setting
def test_compiled_equals_numpy(config):
    log = replace(LOG, frames=LOG.frames[:6])
    one, other = (run(log, replace(config, compiled=compiled)) for compiled in (True, False))
    np.testing.assert_allclose(one.log["log_evidence"], other.log["log_evidence"], atol=1e-5)
    np.testing.assert_allclose(one.log.poses, other.log.poses, atol=1e-7)
    np.testing.assert_allclose(one.system.filter.particles.state, other.system.filter.particles.state, atol=1e-6)
    np.testing.assert_array_equal(one.log["resampled"], other.log["resampled"])
    assert kinds(one.system.filter) == kinds(other.system.filter)


@every_mode
def test_rays_become_points(mode):
    """All at once in all particles, when enough of the weight is ready; none in a first frame."""
    log, seen = desk(1, frames=25), []
    note = lambda run, _: seen.append(kinds(run.system.filter))  # noqa: E731
    done = run(log, replace(SMALL, known=mode), listeners=[note])
    given = set(known(log.known).names.tolist())
    first = {name for name, kind in seen[0].items() if kind is InverseDepth}
    assert first == set(log.frames[0].landmarks.tolist()) - given
    promoted = [name for name, kind in seen[-1].items() if kind is Point and name not in given]
    assert len(promoted) >= 3
    for name in promoted:
        of = [kinds_[name] for kinds_ in seen if name in kinds_]
        turn = of.index(Point)
        assert turn > 0 and set(of[:turn]) == {InverseDepth} and set(of[turn:]) == {Point}
    assert InverseDepth in seen[-1].values() and np.abs(errors(done)[-1]).max() < 0.2


def groups_of(constrain, log=LOG) -> list[set[tuple[type, frozenset[Part]]]]:
    """Models of rays in each frame, with what they inform."""
    found = []

    def record(run, _):
        groups = run.system.report.groups
        found.append({(type(g.model), g.updates) for g in groups if isinstance(g.model, CameraRay)})

    run(log, replace(SMALL, inverse_depth=InverseDepthConfig(constrain)), listeners=[record])
    return found


def test_how_rays_are_used():
    """E06 §5.1: without parallax a measurement of a ray says nothing about its depth."""
    state, landmark = frozenset({Part.STATE}), frozenset({Part.LANDMARK})
    epipolar, marginal, off = (groups_of(constrain) for constrain in ("epipolar", "marginal", "off"))
    both = state | landmark
    assert set().union(*epipolar) == {(EpipolarRay, state), (CameraRay, state), (CameraRay, landmark)}
    assert set().union(*marginal) == {(EpipolarRay, state), (CameraRay, state), (CameraRay, both)}
    assert set().union(*off) == {(CameraRay, landmark)}
    assert epipolar[1] == marginal[1] == {(CameraRay, state)} and off[1] == set()
    assert (EpipolarRay, state) in epipolar[2] & marginal[2]
    # Without known points the prior of depth holds the scale: the marginal, where it counts.
    assert groups_of("marginal", without_known(LOG))[1] == {(CameraRay, state)}


def still_log(seed: int, frames: int) -> FeatureLog:
    """A camera at rest sees four known points and 25 others, with 0.3 px of noise."""
    rng, camera = np.random.default_rng(seed), Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5)
    corners = np.array([[-0.4, -0.3, 2.0], [0.4, -0.3, 2.0], [0.4, 0.3, 2.0], [-0.4, 0.3, 2.0]])
    px = rng.uniform([20.0, 20.0], [620.0, 460.0], (25, 2))
    z = np.concatenate([camera.project(corners), px])
    cov = np.tile(0.09 * np.eye(2), (29, 1, 1))
    seen = [
        FeatureFrame(int(t * 1e9 / 30), np.arange(29), z + rng.normal(0.0, 0.3, z.shape), cov) for t in range(frames)
    ]
    known_points = KnownPoints(np.arange(4), corners, np.tile(1e-6 * np.eye(3), (4, 1, 1)))
    return FeatureLog("still", camera, seen, known_points)


@pytest.mark.parametrize(
    ("known", "seeds"), [(True, 4), pytest.param(False, 2, marks=pytest.mark.slow)], ids=["known points", "none"]
)
def test_a_camera_at_rest_stays(known, seeds):
    """RMS error in the particles' own world, after 60 frames of some recordings; with lines alone it is 6 mm."""
    squares = []
    for seed in range(seeds):
        log = still_log(seed, 60) if known else without_known(still_log(seed, 60))
        filter_ = run(log, MonoConfig(seed=seed, max_new_per_frame=30, map="particles")).system.filter
        paths = SE3.translation(filter_.history.paths()[..., :7])
        squares.append(np.square(np.einsum("tnk,n->tk", paths, filter_.particles.weights)[-1]).sum())
    assert np.sqrt(np.mean(squares)) < 2e-3


@pytest.mark.parametrize("displaced_px", [0.0, 2.0], ids=["at rest", "seen to move"])
@pytest.mark.parametrize("heaviest", [0, 50, 199])
def test_the_density_of_rays_is_continuous_in_the_state(displaced_px, heaviest):
    """Log p along a sideways displacement of 5 mm in steps of 25 µm, wherever on it the heaviest particle is."""
    log, n = still_log(0, 3), 200
    system = run(log, MonoConfig(particles=n, max_new_per_frame=30, map="particles")).system
    belief = system.filter.belief()
    states = np.repeat(belief.state[:1], n, axis=0)
    states[:, :7] = SE3.retract(SE3.identity(), np.linspace(2.5e-5, 5e-3, n)[:, None] * np.eye(6)[3])
    log_weights = np.where(np.arange(n) == heaviest, 0.0, -50.0)
    swept = replace(belief, prior=Prior.exactly(belief.prior.space, states), log_weights=log_weights)
    frame = replace(log.frames[-1], z=log.frames[-1].z + np.array([displaced_px, 0.0]))
    groups = [group for group in system.features.observe(frame, swept) if isinstance(group.model, CameraRay)]
    found = swept.map.information(states, groups, swept.prior)
    log_density = found.log_factor - 0.5 * (found.quad + found.log_det)
    steps = np.diff(log_density)
    has_line = displaced_px > 0.0 and heaviest > 0
    assert sum(group.z.shape[0] for group in groups if isinstance(group.model, EpipolarRay) == has_line) > 15
    # A line leaves open how far along it the camera has moved.
    assert np.abs(np.diff(steps)).max() < 0.1 and (np.abs(steps).max() > 1e-6 or has_line)


@every_setting
def test_two_frames_at_the_same_time(config):
    """No time, no motion: the second frame is a second look from one place."""
    again = replace(LOG.frames[3], stamp_ns=LOG.frames[2].stamp_ns)
    log = replace(LOG, frames=[*LOG.frames[:3], again, *LOG.frames[4:6]], truth=None)
    states = []
    note = lambda run, _: states.append(run.system.filter.particles.state.copy())  # noqa: E731
    assert np.isfinite(run(log, config, listeners=[note]).log.covs).all()
    before = {state.tobytes() for state in np.round(states[2], 9) + 0.0}
    assert {state.tobytes() for state in np.round(states[3], 9) + 0.0} <= before


def test_an_empty_frame():
    """Nothing is seen: the camera goes on and grows uncertain; afterwards it is found again."""
    nothing = np.zeros(0, dtype=np.int64)
    done = run(changed(LOG, 5, lambda f: rows(f, nothing)), SMALL)
    volume = np.linalg.det(done.log.covs)
    assert volume[5] > 10.0 * volume[4] and volume[6] < 0.1 * volume[5]
    assert done.log["nis_dof"][5] == 0 and done.log["log_evidence"][5] == pytest.approx(0.0, abs=1e-9)
    assert np.abs(errors(done)[-1]).max() < 0.1


@every_mode
def test_a_measurement_outside_the_image_is_ignored(mode):
    """Of a known point, of a ray and of a new landmark: as if they had not been there."""
    config, outside = replace(SMALL, known=mode), np.array([700.0, -50.0])
    given = known(LOG.known).names
    frame = LOG.frames[4]
    before = {name for f in LOG.frames[:4] for name in f.landmarks.tolist()}
    ray = next(name for name in frame.landmarks.tolist() if name in before and name not in given)
    of_known = next(name for name in frame.landmarks.tolist() if name in given)
    there = ~np.isin(frame.landmarks, [ray, of_known])

    def beside(f):
        z = f.z.copy()
        z[~there] = outside
        extra = replace(rows(f, np.array([0])), landmarks=np.array([10**6]), z=outside[None])
        parts = zip(("landmarks", "z", "cov_z"), (f.landmarks, z, f.cov_z), strict=True)
        joined = {name: np.concatenate([part, getattr(extra, name)]) for name, part in parts}
        return replace(f, **joined)

    done, expected = (run(changed(LOG, 4, change), config) for change in (beside, lambda f: rows(f, there)))
    assert same(content(done.system.filter), content(expected.system.filter))
    np.testing.assert_array_equal(done.log.poses, expected.log.poses)
    assert not np.array_equal(done.log.poses[4], run(LOG, config).log.poses[4])


def scores(known_as: str, seeds: range) -> np.ndarray:
    """NEES (runs, frames)."""

    def one(seed: int) -> Run:
        config = MonoConfig(particles=30, seed=seed, known=known_as, map="particles")
        return run(desk(100 + seed, frames=12), config)

    return np.array([nees(one(seed)) for seed in seeds])


@pytest.mark.slow
def test_the_stated_uncertainty():
    """Mean NEES, 6 if consistent: near it as a frame; separate landmarks lose what the frame keeps together."""
    frame, points = (scores(mode, range(24)) for mode in ("frame", "points"))
    std = np.sqrt(2.0 * 6.0 / 24)
    late = slice(6, 12)
    assert abs(frame[:, 0].mean() - 6.0) < 4.0 * std and abs(points[:, 0].mean() - 6.0) < 4.0 * std
    assert abs(frame[:, late].mean() - 6.0) < 4.0 * std and points[:, late].mean() > 6.0 + 4.0 * std


# How it starts.

every_velocity = pytest.mark.parametrize("velocity", ["marginal", "joint", "paper"])


def first_only(log: FeatureLog) -> FeatureLog:
    return replace(log, frames=log.frames[:1])


@every_velocity
@every_mode
def test_the_first_frame_finds_the_camera(mode, velocity):
    """Within four standard deviations of the truth, which are as small as the pixels' noise makes them."""
    config = replace(SMALL, known=mode, velocity=VelocityConfig(velocity))
    done = run(first_only(FIRST), config)
    std = np.sqrt(np.diag(done.log.covs[0]))
    assert (std[:3] < 0.03).all() and (std[3:] < 0.03).all() and (std > 1e-4).all()
    assert (np.abs(SE3.local(done.log.poses, known(FIRST.truth).poses[:1])[0]) < 4.0 * std).all()


def test_known_points_are_one_landmark_and_new_ones_are_counted():
    for cov in (known(FIRST.known).cov, np.zeros((4, 3, 3))):
        log = replace(first_only(FIRST), known=replace(known(FIRST.known), cov=cov))
        held = kinds(run(log, replace(SMALL, max_new_per_frame=3)).system.filter)
        assert list(held.values()) == [Constellation] + 3 * [InverseDepth]


@every_velocity
def test_without_known_points_the_first_camera_is_the_world(velocity):
    """Its pose is certain, its velocity as uncertain as the settings say."""
    log, settings = without_known(FIRST), VelocityConfig(velocity, start_rad_s=0.3, start_m_s=0.2)
    config = replace(SMALL, particles=2000, velocity=settings)
    slam = MonoSlam(log.camera, config)
    tracked, filter_ = slam.take(log.frames[0]), slam.filter
    np.testing.assert_array_equal(filter_.particles.state[:, :7], SE3.identity((2000,)))
    np.testing.assert_array_equal(tracked.cov, np.zeros((6, 6)))
    expected = np.repeat([0.3, 0.2], 3)
    if velocity == "marginal":
        substate = list(filter_.marginals.parts.values())[-1]
        np.testing.assert_allclose(np.sqrt(np.diag(substate.cov[0])), expected)
    else:
        np.testing.assert_allclose(filter_.particles.state[:, 7:].std(axis=0), expected, rtol=0.1)


def seeing(count: int) -> FeatureLog:
    """As many of the four known points in the first frame."""
    hidden = known(FIRST.known).names[count:]
    return changed(FIRST, 0, lambda frame: rows(frame, ~np.isin(frame.landmarks, hidden)))


def one_outside(log: FeatureLog) -> FeatureLog:
    """Beyond the border a known point is no measurement: not of the start either."""

    def moved(frame: FeatureFrame) -> FeatureFrame:
        z = frame.z.copy()
        z[frame.landmarks == known(log.known).names[0]] = [5000.0, -3000.0]
        return replace(frame, z=z)

    return changed(log, 0, moved)


def on_a_line() -> FeatureLog:
    given = known(FIRST.known)
    line = given.positions[0] + np.outer(np.arange(4.0), given.positions[1] - given.positions[0])
    return replace(FIRST, known=KnownPoints(given.names, line, given.cov))


@every_mode
@pytest.mark.parametrize(
    ("log", "words"),
    [
        (seeing(0), "needs at least four in the image, got 0"),
        (seeing(3), "needs at least four in the image, got 3"),
        (one_outside(FIRST), "needs at least four in the image, got 3"),
        (on_a_line(), "the known points lie on a line"),
        (
            changed(FIRST, 1, lambda f: replace(f, landmarks=-1 - np.arange(len(f.landmarks)))),
            "a landmark has a negative name",
        ),
        (
            simulate_features(DeskWorld(frames=2, points=60), Measuring(), STEREO, 0),
            "needs a log of one camera, this is a stereo log",
        ),
    ],
    ids=["none", "three", "outside", "line", "negative", "stereo"],
)
def test_logs_that_are_refused(log, words, mode):
    with pytest.raises(InputError, match=words):
        run(log, replace(SMALL, known=mode))


def test_more_known_points_than_needed():
    """One may be outside the image; there may be thirty, and any number as landmarks of their own."""
    done = run(first_only(one_outside(desk(0, known=5))), SMALL)
    assert np.abs(errors(done)[0]).max() < 0.1
    log = desk(known=31, measurements=40)
    with pytest.raises(InputError, match="31 known points are too many for one group: give 30, or set known=points"):
        MonoSlam(log.camera, SMALL, log.known)
    MonoSlam(log.camera, replace(SMALL, known="points"), log.known)
    exact = known(log.known)
    exact = KnownPoints(exact.names[:30], exact.positions[:30], np.zeros((30, 3, 3)))
    done = run(first_only(replace(log, known=exact)), SMALL)
    assert np.abs(errors(done)[0]).max() < 0.05
