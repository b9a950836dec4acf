"""What every system that takes frames promises: to go on from any checkpoint, to survive bad frames, to refuse the past."""

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import count, cycle, islice

import numpy as np
import pytest

from examples.studies.hypotheses import corridor
from examples.studies.image_faults import blur_motion
from examples.studies.lab import LabDrive
from examples.studies.point_worlds import MONO, STEREO, LabWorld, Measuring, RoomWorld, simulate_features
from examples.studies.soak import held_bytes
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers import Frame, ImageFrame
from rbpf.systems.filtering import LikelihoodConfig
from rbpf.systems.mono.config import MonoConfig, StartConfig
from rbpf.systems.mono.slam import MonoSlam
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam
from rbpf.systems.stereo.config import CalibrationConfig, MapConfig, StereoConfig, TriggerConfig
from rbpf.systems.stereo.named_pixels import NamedFrontEnd
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import LAG, System, TrackingState
from tests.core.worlds import content, same
from tests.systems.laser_worlds import laser, scans
from tests.systems.mono_logs import SMALL, desk, without_known
from tests.systems.plane_sequences import CAMERA, known_points, path, sequence, texture, view
from tests.systems.stereo_sequences import errors_m, flat, missing, pairs

pytestmark = pytest.mark.usefixtures("keypoints_once")
KNOWN, LOG, DARK = known_points(), desk(2, frames=8), np.zeros((240, 320), dtype=np.uint8)
ROOM = simulate_features(RoomWorld(frames=24, laps=0.15, points=120), Measuring(), MONO, 0)
"""A way along a wall: points leave the view."""
FAST, NEW = LabWorld(LabDrive(frames=9, every=12), points=2000), Measuring(known=0, measurements=40, new_per_frame=20)
PIXELS = simulate_features(FAST, NEW, STEREO, 0)
LOST = {TrackingState.TRACKED, TrackingState.LOST}


def mono(points=None, **options) -> System:
    return MonoSlam(CAMERA, MonoConfig(particles=5, **options), points)


def stereo(**options) -> System:
    return StereoSlam(pairs(1).rig, replace(StereoConfig.s05(), particles=60, **options))


def named_pairs(disparity_px: float = 0.1) -> System:
    config = StereoConfig(10, trigger=TriggerConfig(0.0, 0.0), self_calibration=CalibrationConfig(disparity_px))
    return StereoSlam(PIXELS.camera, config, front_end=NamedFrontEnd(PIXELS.camera, config))


def blinking(t, image):
    """Frozen first, then dark, then as if nothing had been."""
    if 2 <= t < 9:
        return view(texture(), path(3)[1])
    return DARK if 9 <= t < 14 else image


@dataclass
class Case:
    """A system, its frames, after which of them a run is gone on with, and states that it has been in."""

    make: Callable[[], System]
    frames: Callable[[], Iterable[object]]
    after: tuple[int, ...]
    states: set[TrackingState] = field(default_factory=set)
    joint: bool | None = None  #: whether it ends with a joint map; None where that is not asked.


def unnamed(**options) -> RangeBearingSlam:
    """A robot that does not know which of two doors it has come back to."""
    config = RangeBearingConfig(particles=10, association="ml", map="joint", **options)
    return RangeBearingSlam.of_log(corridor(0), config, keep_associations=True)


def blurred() -> Iterable[object]:
    """Five pairs of which the odometry makes nothing."""
    return blur_motion(25, 10, 5)(pairs(18)).frames()


RESUMED = {
    "known points": Case(lambda: mono(KNOWN), lambda: sequence(8).frames(), (0, 3, 6)),
    "separate points": Case(lambda: mono(KNOWN, known="points"), lambda: sequence(8).frames(), (0, 3, 6)),
    "nothing known": Case(mono, lambda: sequence(12).frames(), (0, 4, 6, 8, 10), {TrackingState.INITIALISING}),
    "lost": Case(lambda: mono(KNOWN), lambda: sequence(18, blinking).frames(), (1, 4, 8, 10, 12, 14, 16), LOST),
    "known points, joint map": Case(
        lambda: mono(KNOWN, map="joint", settled_frames=3), lambda: sequence(22).frames(), (0, 4, 12, 19), joint=True
    ),
    "known points, camera unknown": Case(
        lambda: mono(KNOWN, settled_frames=3, calibrate="online"),
        lambda: sequence(22).frames(),
        (0, 4, 12, 19),
        joint=True,
    ),
    "lost, joint map": Case(
        lambda: mono(KNOWN, map="joint", settled_frames=1),
        lambda: sequence(30, lambda t, image: blinking(t - 12, image)).frames(),
        (15, 20, 22, 26),
        LOST,
        True,
    ),
    "waiting": Case(lambda: mono(KNOWN), lambda: sequence(4, lambda t, i: None if t < 2 else i).frames(), (0, 1, 2)),
    "named": Case(lambda: MonoSlam(LOG.camera, SMALL, LOG.known), lambda: LOG.frames, (0, 3, 6)),
    "named, nothing known": Case(
        lambda: MonoSlam(LOG.camera, replace(SMALL, start=StartConfig(first_adjustment=4))),
        lambda: without_known(LOG).frames,
        (0, 2, 3, 5),
    ),
    "named, sub-maps": Case(
        lambda: MonoSlam(ROOM.camera, replace(SMALL, map="joint", settled_frames=1, submap=16), ROOM.known),
        lambda: ROOM.frames,
        (12, 15, 18),
        joint=True,
    ),
    "pairs": Case(
        stereo, lambda: pairs(12, lambda t, pair: missing(pair) if t in (0, 5) else pair).frames(), (0, 5, 6, 9)
    ),
    "pairs, joint map": Case(
        lambda: StereoSlam(pairs(1).rig, StereoConfig(particles=60, map=MapConfig(submap=30))),
        lambda: pairs(12).frames(),
        (0, 5, 7),
    ),
    "pairs, lost": Case(stereo, blurred, (12,), LOST),
    "named pairs": Case(named_pairs, lambda: PIXELS.frames, (0, 5)),
    "named pairs, calibrating": Case(
        lambda: named_pairs(8.0), lambda: (replace(one, z=np.add(one.z, [0, 0, 8])) for one in PIXELS.frames), (0, 3)
    ),
    "robot, own maps": Case(
        lambda: robot(RangeBearingConfig(particles=4, map="particles"))[0], lambda: islice(robot()[1], 12), (0, 5, 9)
    ),
    "robot, joint map": Case(
        lambda: robot(RangeBearingConfig(particles=10, window=4))[0], lambda: islice(robot()[1], 16), (0, 5, 9)
    ),
    "robot, 100,000 km away": Case(
        lambda: robot(RangeBearingConfig(particles=10))[0],
        lambda: (
            replace(f, delta=np.array([0.0, 1e8, 1e8]) if f.stamp_ns == 3 else f.delta) for f in islice(robot()[1], 8)
        ),
        (3, 5),
    ),
    "robot, unnamed": Case(unnamed, lambda: corridor(0).frames, (0, 44, 58, 62)),
    "scans": Case(lambda: laser(), lambda: scans(12), (0, 5, 6, 9), {TrackingState.TRACKED, TrackingState.PREDICTED}),
}


def robot(config: RangeBearingConfig | None = None) -> tuple[System, Iterator[Frame]]:
    """It stands still among three landmarks."""
    rng, cov, still = np.random.default_rng(0), np.tile(np.diag([0.01, 0.0004]), (3, 1, 1)), SE2.identity()
    z = np.array([[2.0, 0.3], [3.0, -0.5], [4.0, 1.0]])
    noise = [0.1, 0.02]
    frames = (
        Frame(t, still if t else None, 1e-4 * np.eye(3), np.arange(3), z + rng.normal(size=(3, 2)) * noise, cov)
        for t in count()
    )
    return RangeBearingSlam(config or RangeBearingConfig(particles=10, map="particles")), frames


def camera(config: MonoConfig = SMALL) -> tuple[System, Iterator[object]]:
    """It moves to and fro before the same features."""
    there_and_back = cycle(LOG.frames + LOG.frames[-2:0:-1])
    frames = (replace(frame, stamp_ns=33_333_333 * t) for t, frame in enumerate(there_and_back))
    return MonoSlam(LOG.camera, config, LOG.known), frames


@pytest.mark.slow
@pytest.mark.parametrize("live", [robot, camera])
def test_memory_does_not_grow_by_default(live):
    system, frames = live()
    held = {}
    for t in range(1000):
        system.take(next(frames))
        held[t] = held_bytes(system.filter) if t in (199, 999) else 0
    assert held[999] < 1.25 * held[199] and system.filter.history.stamps_ns.size == LAG


@pytest.mark.parametrize("live", [robot, camera])
def test_a_recordings_whole_paths_are_kept_where_they_fit(live):
    system, frames = live()
    system.keep_paths(LAG + 10)
    for _ in range(LAG + 10):
        system.take(next(frames))
    assert system.filter.history.stamps_ns.size == LAG + 10
    with pytest.raises(
        InputError, match=r"the paths of \d+ particles over 10{12} (frames|steps) \(lag keeps fewer\) would take"
    ):
        system.keep_paths(10**12)
    few, _ = live(replace(system.config, lag=5))
    few.keep_paths(10**12)
    assert few.filter.history.lag == 5


@pytest.mark.slow
@pytest.mark.parametrize("case", RESUMED.values(), ids=RESUMED)
def test_a_checkpoint_after_any_frame_and_a_copy_go_on_with_the_same_bytes(case, tmp_path):
    system, whole, frames, resumed = case.make(), [], list(case.frames()), []
    for t, frame in enumerate(frames):
        whole.append(system.take(frame))
        assert whole[-1].values.keys() == {column.name for column in system.columns}
        assert whole[-1].observed.keys() == {ragged.name for ragged in system.observed}
        if t in case.after:
            system.save(tmp_path / f"{t}.npz", {"of the caller": np.array(t)})
            resumed.append((t, case.make()))
            assert resumed[-1][1].load(tmp_path / f"{t}.npz")["of the caller"] == t
            resumed += [(t, copy.deepcopy(system))] if t == case.after[-2:][0] else []
    assert {each.state for each in whole} >= case.states
    assert case.joint is None or (system.filter.consolidation is not None) is case.joint
    for t, again in resumed:
        for frame, theirs in zip(frames[t + 1 :], whole[t + 1 :], strict=True):
            mine = again.take(frame)
            assert mine.pose.tobytes() == theirs.pose.tobytes() and mine.cov.tobytes() == theirs.cov.tobytes()
            assert (mine.state, mine.messages) == (theirs.state, theirs.messages)
            assert (mine.revision is None) == (theirs.revision is None)
            np.testing.assert_equal(mine.observed, theirs.observed)
            for name in mine.values.keys() - {name for name in mine.values if name.startswith("seconds")}:
                np.testing.assert_equal(mine.values[name], theirs.values[name])
        assert same(content(again.filter), content(system.filter)) and same(again.arrays(), system.arrays())
        np.testing.assert_equal(vars(again.map()), vars(system.map()))


def image(bad: object) -> Callable[[ImageFrame], ImageFrame]:
    return lambda frame: replace(frame, image=bad)


BAD_IMAGES = {
    "none": (image(None), "there is no image"),
    "black": (image(DARK), "the image shows nothing"),
    "smaller": (image(DARK[:100, :100]), "expected 320x240"),
    "colour": (image(np.zeros((240, 320, 3), dtype=np.uint8)), "expected 320x240"),
    "empty": (image(DARK[:0]), "expected 320x240"),
    "no number": (image(DARK * np.nan), "expected 320x240"),
    "no array": (image("image"), "expected 320x240"),
}
NOISE = np.random.default_rng(0).integers(0, 256, (2, 240, 320), dtype=np.uint8)
BAD_PAIRS = {
    "missing": (missing, "the right image is missing"),
    "black": (flat, "it shows 0 features"),
    "wrong size": (lambda f: replace(f, image=f.image[:100], right=f.right[:100]), "the camera takes 320x240 px"),
    "two sizes": (lambda f: replace(f, image=f.image[:100]), "must be of one size"),
    "wrong type": (lambda f: replace(f, image=f.image.astype(float)), "float64"),
    "colour": (lambda f: replace(f, image=np.dstack([f.image] * 3)), "(240, 320, 3)"),
    "noise": (lambda f: replace(f, image=NOISE[0], right=NOISE[1]), "it shows 0 features, 8 are needed; 21.9 % of"),
    "same stamp": (lambda f: replace(f, stamp_ns=f.stamp_ns - 66_666_666), "it has the stamp of the last one"),
}
SURVIVED = {
    "known points": (lambda: mono(KNOWN), sequence, BAD_IMAGES, "found"),
    "nothing known": (mono, sequence, BAD_IMAGES, "found"),
    "pairs": pytest.param((stereo, pairs, BAD_PAIRS, "agreeing"), marks=pytest.mark.slow),
}


@pytest.mark.parametrize("case", SURVIVED.values(), ids=SURVIVED)
def test_bad_frames_are_survived_and_said(case):
    """One of each kind, two good ones between them: a bad one keeps a predicted pose, and what follows is as ever."""
    make, recorded, kinds, used = case
    bad, system, told = dict(zip(range(4, 4 + 3 * len(kinds), 3), kinds.items(), strict=True)), make(), []
    for t, frame in enumerate(recorded(max(bad) + 3).frames()):
        told.append(system.take(bad[t][1][0](frame) if t in bad else frame))
    spread = [np.trace(each.cov) for each in told]
    for t, each in enumerate(told):
        if t in bad:
            kind, (_, words) = bad[t]
            assert each.state is TrackingState.PREDICTED and not each.values[used]
            assert len(each.messages) == 1 and words in each.messages[0]
            assert spread[t + 2] < 10.0 * spread[t - 1]
            assert recorded is sequence or kind == "same stamp" or spread[t] > 50.0 * spread[t - 1]
        else:
            assert each.state in (TrackingState.TRACKED, TrackingState.INITIALISING) and not each.messages
            assert t == 0 or each.values[used] > 10
    if recorded is pairs:
        assert errors_m(np.array([each.pose for each in told]), pairs(len(told)))[:-3].max() < 0.01


def sure(**options) -> System:
    return robot(RangeBearingConfig(particles=4, likelihood=LikelihoodConfig("outliers"), **options))[0]


def readings() -> Iterable[Frame]:
    return islice(robot()[1], 5)


def wrong(words: str, **given: list[object]) -> list[tuple[dict[str, object], str]]:
    """Frames with one thing in them wrong, and what is said of it."""
    return [({name: each}, words) for name, values in given.items() for each in values]


NO_STAMPS = wrong("stamp_ns must be a whole number of nanoseconds", stamp_ns=[np.nan, "x", -1, 0.5, 2**62, 10**30])
PAST = [*wrong("time runs backwards", stamp_ns=[99]), *NO_STAMPS]
UNSTAMPED = [*PAST, *wrong("whole number of nanoseconds", stamp_ns=[None])]
READINGS = [
    *wrong("the array z must hold finite numbers", z=[np.full((3, 2), np.nan)]),
    *wrong("z must be an array, got lists of different lengths", z=[[[2.0, 0.3], [3.0]]]),
    *wrong(r"z must hold numbers of shape \(K, 2\), got \((2,)?\)", z=[np.ones(2), None]),
    *wrong(r"cov_z must hold numbers of shape \(K = 3, 2, 2\), got", cov_z=[np.zeros((n, 2, 2)) for n in (2, 4)]),
    *wrong(r"must hold whole numbers of shape \(3\)", landmarks=[range(2), range(4), [0, 1, 3.5], [np.nan] * 3]),
    *wrong("landmarks must hold whole numbers from 0 to", landmarks=[[0, 1, -6], [0, 1, 2**62]]),
    *wrong(r"delta must hold numbers of shape \(3\), got", delta=[np.zeros(2), "left"]),
]
FEATURES = wrong("frame at .* ns: ", z=[np.full((20, 2), np.nan)], cov_z=[-np.ones((20, 2, 2))], landmarks=[[1] * 20])
REFUSED = {
    "images": (lambda: mono(KNOWN), lambda: sequence(5).frames(), UNSTAMPED),
    "images, waiting": (lambda: mono(KNOWN), lambda: sequence(4, lambda t, i: i if t > 1 else None).frames(), PAST),
    "pairs": (stereo, lambda: pairs(5).frames(), UNSTAMPED),
    "features": (lambda: MonoSlam(LOG.camera, SMALL, LOG.known), lambda: LOG.frames[:9], [*UNSTAMPED, *FEATURES]),
    "features of pairs": (named_pairs, lambda: PIXELS.frames[:9], [*UNSTAMPED, *FEATURES]),
    "robot, joint map": (sure, readings, [*PAST, *READINGS]),
    "robot, own maps": (lambda: sure(map="particles"), readings, READINGS),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_a_refused_frame_changes_nothing(case):
    make, recorded, refused = case
    system = make()
    for t, frame in enumerate(recorded()):
        frame = replace(frame, stamp_ns=100 + frame.stamp_ns)
        before = content(system.filter), {name: np.copy(array) for name, array in system.arrays().items()}
        for changed, words in refused if t else []:
            with pytest.raises(InputError, match=words):
                system.take(replace(frame, **changed))
            assert same(content(system.filter), before[0]) and same(system.arrays(), before[1])
        assert system.take(frame).state in (TrackingState.TRACKED, TrackingState.INITIALISING)
