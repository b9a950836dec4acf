"""Chained motions, and what is assumed between them."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.motion.odometry import Odometry
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.stereo.config import MapConfig, OdometryConfig, StereoConfig, TriggerConfig
from rbpf.systems.stereo.named_pixels import NamedFrontEnd
from rbpf.systems.stereo.slam import StereoSlam
from rbpf.systems.system import TrackingState

RIG = RectifiedStereo(Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5), 0.12)
SECOND = 1_000_000_000
STEP = np.array([0.01, 0.03, -0.02, 0.05, 0.02, 0.04])


def frames(count: int = 4, missing: tuple[int, ...] = ()) -> list[FeatureFrame]:
    """Exact pixels of the same points from a camera at constant velocity, one frame per second."""
    points = np.random.default_rng(3).uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 6.0], size=(60, 3))
    out = []
    for t in range(count):
        z = RIG.project(SE3.inverse_transform(SE3.exp(t * STEP), points))
        kept = np.arange(0 if t in missing else 60)
        out.append(FeatureFrame(t * SECOND, kept, z[kept], np.tile(0.01 * np.eye(3), (60, 1, 1))[kept]))
    return out


def slam(dof: int = 6, **options) -> StereoSlam:
    config = replace(StereoConfig.s05(), particles=20, dof=dof, map=MapConfig(kind="particles", used=False), **options)
    return StereoSlam(RIG, config, front_end=NamedFrontEnd(RIG, config))


NEVER = {"trigger": TriggerConfig(9.0, 9.0)}


@pytest.mark.parametrize(("independent", "low", "high"), [(False, 0.6, 1.5), (True, 0.05, 0.3)], ids=["exact", "s05"])
def test_chained_motions_over_persistent_features(independent, low, high):
    """NEES per degree of freedom after ten pairs, 16 runs, σ 0.14: consecutive motions share the pixels between them."""
    rng, noise_px, nees = np.random.default_rng(5), 0.5, []
    for _ in range(16):
        one = slam(odometry=OdometryConfig(independent=independent), **NEVER)
        for frame in frames(11):
            noise = noise_px * rng.normal(size=frame.z.shape)
            cov = np.tile(noise_px**2 * np.eye(3), (len(noise), 1, 1))
            told = one.take(replace(frame, z=frame.z + noise, cov_z=cov))
        off = SE3.local(told.pose, SE3.exp(10 * STEP))
        nees.append(off @ np.linalg.solve(told.cov, off) / 6)
    assert low < np.mean(nees) < high


def test_cameras_that_begin_to_disagree_are_noticed_once(monkeypatch, tmp_path):
    """A twentieth of the matches has a negative disparity from pair 20 on; a checkpoint knows what was said."""
    one, again, said = slam(**NEVER), slam(**NEVER), {}
    for t, frame in enumerate(frames(40)):
        monkeypatch.setattr(one.front_end, "impossible", lambda t=t: (0 if t < 20 else 10, 200), raising=False)
        said[t] = [words for words in one.take(frame).messages if "check the calibration" in words]
        if t == 30:
            one.save(tmp_path / "checkpoint.npz")
    (first,) = (t for t, words in said.items() if words)
    assert 20 < first <= 30
    (doubt,) = said[first]
    assert doubt == "3 % of the matches have a negative disparity, which no point in space has: check the calibration"
    again.load(tmp_path / "checkpoint.npz")
    monkeypatch.setattr(again.front_end, "impossible", lambda: (10, 200), raising=False)
    assert again.take(frames(32)[31]).messages == ()


def test_over_a_missing_pair():
    """Exact pixels: the motion is found, whether in two steps or in one over the missing pair."""
    for missing in ((), (1,)):
        said = [slam_.take(frame) for slam_ in [slam(**NEVER)] for frame in frames(3, missing)]
        two = SE3.compose(SE3.exp(STEP), SE3.exp(STEP))
        np.testing.assert_allclose(said[2].values["odometry"], two, atol=1e-6)
        np.testing.assert_allclose(said[2].pose, two, atol=1e-6)
        assert said[2].values["agreeing"] == 60 and np.diagonal(said[2].cov).max() < 1e-2
    np.testing.assert_array_equal(said[1].values["odometry"], SE3.identity())
    assert np.sqrt(said[1].cov[3, 3]) == 1.0  # the expected speed's deviation, after a second
    assert [one.values["assumed"] for one in said] == [0, 1, 0]
    assert [one.state for one in said] == [TrackingState.TRACKED, TrackingState.PREDICTED, TrackingState.TRACKED]


def test_pairs_that_are_passed_over_are_counted_and_the_velocity_goes_on():
    said = [*map(slam().take, frames(6, missing=(0, 4, 5)))]
    assert [one.values["assumed"] for one in said] == [1, 0, 0, 0, 1, 2]
    assert said[0].messages[0].endswith("needed; the world begins with the first pair that is measured")
    for t in (4, 5):
        np.testing.assert_allclose(said[t].values["odometry"], SE3.exp((t - 1) * STEP), atol=1e-6)
        (message,) = said[t].messages
        assert message == "passed over: it shows 0 features, 8 are needed; the last velocity is assumed, widely"


def test_in_the_plane():
    slam_ = slam(dof=3, **NEVER)
    said = [slam_.take(frame) for frame in frames(3)][-1]
    turned = SE3.log(said.values["odometry"])
    np.testing.assert_allclose(turned[[0, 2, 4]], 0.0, atol=1e-12)
    assert abs(turned[1]) > 0.05
    np.testing.assert_allclose(slam_.reckoning.since_update.cov[[0, 2, 4]], 0.0, atol=1e-12)


def test_what_triggers():
    config, rest = TriggerConfig(moved_m=0.1, turned_rad=0.2, frames=5), Odometry.at_rest()
    assert config.reached(rest, 5) and not config.reached(rest, 1)
    assert TriggerConfig(0.0, 1.0).reached(rest, 1) and not TriggerConfig(0.1, 0.2).reached(rest, 500)
    for axis, size, enough in ((4, 0.09, False), (4, 0.11, True), (0, 0.19, False), (1, 0.21, True)):
        motion = Odometry(SE3.exp(size * np.eye(6)[axis]), np.zeros((6, 6)))
        assert config.reached(motion, 1) == enough
    assert config.reached(Odometry(SE3.identity(), np.diag([0.0, 0.0, 0.0, 0.01, 0.0, 1e-4])), 1)
