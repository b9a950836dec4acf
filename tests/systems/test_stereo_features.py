"""Stereo SLAM on simulated pixels with known association, beside the batch optimum of the same measurements."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.lab import LabDrive
from examples.studies.point_worlds import STEREO, LabWorld, Measuring, RoomWorld, simulate_features
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.recordings import filter_opened, open_features
from rbpf.runs.run import Run
from rbpf.sensors.camera.points import StereoPoint
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers.measurements import InitialEstimate
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.stereo.config import (
    CalibrationConfig,
    MapConfig,
    OdometryConfig,
    RecoveryConfig,
    StereoConfig,
    TriggerConfig,
)
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.gtsam.camera import solve_features

pytestmark = pytest.mark.slow

CONFIG = replace(
    StereoConfig.s05(),
    particles=200,
    trigger=TriggerConfig(0.0, 0.0),
    likelihood=LikelihoodConfig("gaussian"),
    proposal=ProposalConfig("ekf", iterations=1),
)
JOINT = replace(CONFIG, particles=50, map=MapConfig(kind="joint"), calibrate="off")


def simulated(frames: int = 40, seed: int = 0, camera=STEREO, **options) -> FeatureLog:
    world = LabWorld(LabDrive(frames=frames, every=4), points=8000)
    return simulate_features(world, Measuring(known=0, measurements=40, new_per_frame=20, **options), camera, seed)


@pytest.fixture(scope="module")
def log() -> FeatureLog:
    return simulated()


def filtered(log: FeatureLog, config: StereoConfig = CONFIG, **options) -> Run:
    return filter_opened(open_features(log, config), **options)


@pytest.fixture(scope="module")
def run(log) -> Run:
    return filtered(log)


def rmse(log: FeatureLog, poses: np.ndarray) -> float:
    """Of the positions; the first camera is the world."""
    true = SE3.between(log.truth.poses[0], log.truth.poses)
    off = SE3.translation(poses) - SE3.translation(true)
    return float(np.sqrt(np.square(off).sum(axis=1).mean()))


def nees_of(run: Run) -> float:
    """Of the poses, per degree of freedom."""
    return whitened_errors(SE3, run.log.poses[1:], run.log.covs[1:], run.truth.poses[1:]).nees.mean() / 6


def test_beside_the_batch(log, run):
    """The filter sees the past only, the batch all of it; the odometry forgets."""
    batch = solve_features(log, InitialEstimate(run.log.poses, {}), marginals=False).world_from_body
    batch = SE3.between(batch[0], batch)
    ours, best, alone = (rmse(log, poses) for poses in (run.log.poses, batch, run.log["odometry"]))
    assert ours < 2.5 * best and ours < 0.8 * alone
    assert np.isfinite(run.log["log_evidence"]).all() and run.system.map().ids.size > 100


def test_what_was_measured_is_told_as_it_came(log, run):
    told = run.system.measurements("told", run.log)
    for ours, theirs in zip(told.frames, log.frames, strict=True):
        np.testing.assert_equal(vars(ours), vars(theirs))


@pytest.mark.parametrize("kind", ["truncated", "outliers"])
def test_the_prior_proposal(log, kind):
    """The filter is better than its odometry, by a density and by S05's truncated form, which gives no evidence.
    What the latter clips, a quarter of these true measurements, updates the landmarks all the same."""
    likelihood = replace(StereoConfig().likelihood, kind=kind)
    run = filtered(log, replace(CONFIG, particles=400, likelihood=likelihood, proposal=ProposalConfig("prior")))
    assert rmse(log, run.log.poses) < rmse(log, run.log["odometry"])
    assert np.isfinite(run.log["log_evidence"]).all() == (kind == "outliers")


def test_nees_of_the_pose():
    """Per degree of freedom, 12 recordings of 20 pairs: where each pixel counts once it is 1, in S05 1.4 and more.
    With a joint map 50 particles are enough."""
    density = replace(StereoConfig().likelihood, kind="outliers")
    twice = replace(CONFIG, likelihood=density)
    role, own = OdometryConfig(role="proposal"), MapConfig(kind="particles", weigh="all")
    once = replace(twice, proposal=ProposalConfig("ekf"), odometry=role, map=own)
    nees, logs = [], [simulated(20, seed) for seed in range(12)]
    for config in (once, twice, JOINT):
        nees.append(np.mean([nees_of(filtered(log, config)) for log in logs]))
    assert 0.75 < nees[0] < 1.25  # 1.20 with a standard error of 0.10
    assert nees[1] > 1.2 * nees[0] and 0.75 < nees[2] < 1.25


def test_a_loop_closes_on_landmarks_of_old_sub_maps():
    """Twice round a room: as good and as sure of itself as one Gaussian of all, though hardly more is held than is seen."""
    measuring = Measuring(noise_px=0.5, measurements=15, known=0, new_per_frame=15, nearest_m=0.5, farthest_m=7.0)
    log = simulate_features(RoomWorld(frames=120, laps=2.0, points=200), measuring, STEREO, 0)
    sizes, runs = list[int](), list[Run]()
    for most in (1000, 30):
        opened = open_features(log, replace(JOINT, map=MapConfig(kind="joint", submap=most)))
        runs.append(filter_opened(opened, [lambda run, tracked: sizes.append(run.system.joint.ids.size)]))
    off = [np.linalg.norm(SE3.translation(run.log.poses) - SE3.translation(run.truth.poses), axis=1) for run in runs]
    assert off[1][-40:].mean() < 1.5 * off[0][-40:].mean() + 0.003
    assert off[1][-40:].mean() < 0.5 * off[1][20:60].max()
    ours, whole = (run.system.map().named() for run in runs[::-1])
    assert ours.keys() == whole.keys() and max(sizes[120:]) < 60 < len(ours)
    assert len(runs[1].system.joint.old.maps) > 5 and nees_of(runs[1]) < 2.0


def test_wrong_pixels_in_a_joint_map():
    """One in twenty lies anywhere: with outliers in the likelihood the filter knows its error, with a Gaussian it does not."""
    wrong, nees = simulated(outlier_rate=0.05), []
    for kind in ("outliers", "gaussian"):
        likelihood = replace(StereoConfig().likelihood, kind=kind)
        nees.append(nees_of(filtered(wrong, replace(JOINT, likelihood=likelihood))))
    assert nees[0] < 2.0 and nees[1] > 10.0


def test_slopes_by_an_error_of_all_disparities():
    rng = np.random.default_rng(0)
    points, state = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (6, 3)), SE3.exp(0.1 * rng.normal(size=6))
    model, z, step = StereoPoint(STEREO, about=np.zeros(1)), STEREO.project(points), np.array([0.0, 0.0, 1e-5])
    np.testing.assert_array_equal(model.by_substate(state, points)[..., 0], np.tile([0.0, 0.0, 1.0], (6, 1)))
    numeric = (STEREO.triangulate(z - step) - STEREO.triangulate(z + step)) / 2e-5
    np.testing.assert_allclose(model.new_by_substate(z)[..., 0], numeric, rtol=1e-6)


def test_an_error_of_all_disparities_is_found():
    """As exactly as it says, by runs whose paths know their errors; what they hand on is without it. Four recordings."""
    joint, error, squared, nees = StereoConfig(trigger=CONFIG.trigger, calibrate="off"), [0.0, 0.0, 0.3], [], []
    online = replace(joint, calibrate="online", self_calibration=CalibrationConfig(disparity_px=0.3))
    for seed in range(4):
        log = simulated(40, seed)
        wrong = replace(log, frames=[replace(frame, z=frame.z + error) for frame in log.frames])
        run, without = (filtered(wrong, config) for config in (online, joint))
        nees.append([nees_of(run), nees_of(without)])
        found, std = run.system.calibration()
        squared.append(((found - 0.3) / std) ** 2)
        np.testing.assert_allclose(run.system._kept.features.z, wrong.frames[-1].z - [0.0, 0.0, found], atol=1e-9)
        assert std < 0.2 and run.system.summary(run.log)["calibration"]["disparity_offset_px"] == found
        for ours, theirs in zip(run.system.measurements("told", run.log).frames, log.frames, strict=True):
            np.testing.assert_allclose(ours.z - theirs.z, np.tile([0.0, 0.0, 0.3 - found], (len(ours), 1)), atol=1e-9)
    assert np.mean(squared) < 2.37  # 95 % of χ² with four degrees of freedom
    assert np.mean(nees, axis=0)[0] < 1.3 and np.mean(nees, axis=0)[1] > 2.5  # 1.1 and 3.7


def test_a_pair_calibrates_itself_where_that_explains_it_better(log):
    """Then it is as if it had done so from the start, but for the evidence until then; else as if it were certain."""
    config = StereoConfig(trigger=CONFIG.trigger, self_calibration=CalibrationConfig(disparity_px=2.0))
    wrong = replace(log, frames=[replace(frame, z=frame.z + np.array([0.0, 0.0, 2.0])) for frame in log.frames])
    tried, online, off = (filtered(wrong, replace(config, calibrate=each)) for each in ("auto", "online", "off"))
    (found, std), right = tried.system.calibration(), online.system.calibration()[0]
    assert abs(found - right) < 1.5 * std and not tried.log["offset_px"][:5].any()
    assert [message.split(": ")[-1] for message in tried.messages] == ["the pair calibrates itself from here on"]
    apart = [np.abs(SE3.translation(run.log.poses) - SE3.translation(online.log.poses)).max() for run in (tried, off)]
    assert apart[0] < 0.25 * apart[1] and 18.0 < (online.log["log_evidence"] - tried.log["log_evidence"]).sum() < 40.0
    tried, off = (filtered(log, replace(config, calibrate=each)) for each in ("auto", "off"))
    np.testing.assert_allclose(tried.log.poses, off.log.poses, atol=1e-4)
    assert "calibration" not in tried.system.summary(tried.log)


def test_settings_that_do_not_go_together_are_refused(log):
    with pytest.raises(InputError, match=r"calibrate=online holds .* leave out map\.kind=particles"):
        filtered(log, replace(CONFIG, calibrate="online"))
    with pytest.raises(InputError, match=r"odometry\.role=proposal needs proposal\.kind=ekf and map\.weigh=all"):
        filtered(log, replace(CONFIG, odometry=OdometryConfig(role="proposal")))
    with pytest.raises(InputError, match=r"a likelihood that is a density, and likelihood\.kind=truncated is none"):
        filtered(log, replace(JOINT, likelihood=StereoConfig.s05().likelihood))


def without_names(log: FeatureLog, first: int, count: int) -> FeatureLog:
    """In some frames every landmark has a name of its own: nothing is known of the motion there."""
    frames = list(log.frames)
    for t in range(first, first + count):
        frames[t] = replace(frames[t], landmarks=frames[t].landmarks + 100_000 * (1 + t))
    return replace(log, frames=frames)


def test_found_again_by_what_was_put_away(log):
    """All landmarks are in old sub-maps while the camera is lost; those in view are held again when it is found."""
    broken, poses, messages = without_names(log, 20, 3), [], []
    slam = open_features(broken, JOINT).system
    for t, frame in enumerate(broken.frames):
        if t == 23:
            slam.joint.put_away(slam.joint.ids)
            slam.filter.consolidate()
            assert not slam.joint.ids.size
        told = slam.take(frame)
        poses.append(told.pose)
        messages += told.messages
    assert any("found again by" in message for message in messages) and rmse(log, np.array(poses)) < 0.05


def test_found_again_by_names(log):
    """Three frames that match nothing, then the old names: the prior proposal alone does not find back."""
    config = replace(CONFIG, likelihood=LikelihoodConfig("truncated"), proposal=ProposalConfig("prior"))
    broken, errors = without_names(log, 20, 3), []
    for used in (True, False):
        run = filtered(broken, replace(config, recovery=RecoveryConfig(used=used)))
        errors.append(rmse(log, run.log.poses))
        assert any("found again by" in message for message in run.messages) == used
        assert run.log["assumed"][20:23].all() and not run.log["assumed"][24:].any()
    assert errors[0] < 0.5 * errors[1]
