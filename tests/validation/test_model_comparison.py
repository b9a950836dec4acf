import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.studies.point_worlds import MONO, STEREO, DeskWorld, Measuring, simulate_features
from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.runs.folder import write_run
from rbpf.runs.recordings import RobotRecording, filter_recording
from rbpf.sensors.readers import LogNoise
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import OdometryConfig, StereoConfig, TriggerConfig
from rbpf.validation.consistency.model_comparison import compare_evidence, evidence_difference
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

pytestmark = pytest.mark.slow

CONFIG = RangeBearingConfig(particles=400)


def test_the_log_normal_law_is_inverted_and_its_error_right():
    """log Ẑ ~ N(log Z − σ²/2, σ²): the estimates scatter about log Z as much as they say."""
    rng = np.random.default_rng(0)
    offs = []
    for _ in range(2000):
        logs = 10.0 - 0.5 * 0.8**2 + 0.8 * rng.normal(size=40)
        found = evidence_difference(logs, np.full(2, 4.0))
        offs.append((found.difference - 6.0) / found.error)
    assert np.mean(offs) == pytest.approx(0.0, abs=0.15)
    assert np.std(offs) == pytest.approx(1.0, abs=0.1)


def test_named_landmarks_and_gaussian_noise_are_compared_in_batch(tmp_path):
    """Without particles, a hundred times as sharp; the filters find the same within their error."""
    log = RobotRecording(tmp_path / "log")
    simulate_robot(RobotWorld(steps=30), log.log, seed=0)
    wrong = replace(CONFIG, noise=LogNoise(std_range_m=0.03))
    sharp = compare_evidence(CONFIG, wrong, log, range(3))
    assert sharp.error < 0.05 and sharp.difference > 5.0 * sharp.error
    assert sharp.sentence("A", "B").startswith("A explains the recording better than B")
    assert compare_evidence(wrong, CONFIG, log, range(3)).difference == pytest.approx(-sharp.difference)
    # What is no other model: outliers that never come.
    rare = LikelihoodConfig("outliers", outlier_rate=1e-9)
    by_filters = [replace(config, likelihood=rare, submap=5) for config in (CONFIG, wrong)]
    found = compare_evidence(*by_filters, log, range(3))
    assert found.error > 2.0 * sharp.error
    assert abs(found.difference - sharp.difference) < 4.0 * found.error + 1.0


def test_a_likelihood_that_is_no_density_is_refused_with_the_reason():
    log = RobotRecording(Path("not looked at"))
    truncated = replace(CONFIG, likelihood=LikelihoodConfig(kind="truncated"))
    for pair, name in (((truncated, CONFIG), "first"), ((CONFIG, truncated), "second")):
        with pytest.raises(InputError, match=f"the {name} configuration has no evidence.*not a density"):
            compare_evidence(*pair, log, range(2))
    with pytest.raises(InputError, match="not a density"):
        evidence_difference([1.0, np.nan], [1.0, 2.0])


def test_monocular_configurations_are_compared_on_features():
    log, usual = (simulate_features(DeskWorld(frames=25), Measuring(), MONO, 0), MonoConfig(max_new_per_frame=0))
    slow = replace(usual, velocity=replace(usual.velocity, walk_m_s=0.001, walk_rad_s=0.001))
    found = compare_evidence(usual, slow, log, range(2))
    assert found.difference > 0.0
    for pair in ((usual, replace(usual, max_new_per_frame=1)), (MonoConfig(), MonoConfig(max_new_per_frame=1))):
        with pytest.raises(InputError, match="who starts fewer explains more; set max_new_per_frame to 0"):
            compare_evidence(*pair, log, range(2))


S05, HALVES = StereoConfig.s05(), OdometryConfig(split="apart")
APART = replace(S05, particles=60, odometry=HALVES, likelihood=LikelihoodConfig(kind="gaussian"))


def test_stereo_configurations_are_compared_on_what_odometry_has_not_used():
    log = simulate_features(DeskWorld(frames=20), Measuring(), STEREO, 0)
    shaken = replace(APART, proposal=ProposalConfig("prior"), map=replace(APART.map, used=False))
    found = compare_evidence(APART, APART, log, range(3))
    assert abs(found.difference) <= 1e-9 and np.isfinite(found.log_evidence_a)
    assert found.log_evidence_a != compare_evidence(shaken, shaken, log, range(2)).log_evidence_a


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        (S05, APART, "the first configuration has no evidence.*'truncated' is not a density"),
        (replace(APART, odometry=OdometryConfig()), APART, "count them twice"),
        (replace(APART, dof=3), APART, "differ in dof"),
        (replace(APART, trigger=TriggerConfig(moved_m=0.5)), APART, "differ in trigger"),
    ],
)
def test_stereo_configurations_without_a_common_evidence_are_refused(first, second, message):
    log = simulate_features(DeskWorld(frames=3), Measuring(), STEREO, 0)
    with pytest.raises(InputError, match=message):
        compare_evidence(first, second, log, range(2))


def test_what_does_not_belong_together_is_refused():
    log = RobotRecording(Path("not looked at"))
    with pytest.raises(InputError, match="different systems"):
        compare_evidence(CONFIG, MonoConfig(), log, range(2))
    with pytest.raises(InputError, match="does not filter"):
        compare_evidence(MonoConfig(max_new_per_frame=0), MonoConfig(max_new_per_frame=0), log, range(2))
    with pytest.raises(InputError, match="set the same association"):
        compare_evidence(CONFIG, replace(CONFIG, association="ml"), log, range(2))
    with pytest.raises(InputError, match="2 seeds"):
        compare_evidence(CONFIG, CONFIG, log, [1])


def test_runs_are_compared_by_their_folders(tmp_path, capsys, plain_pictures):
    simulate_robot(RobotWorld(steps=12), tmp_path / "log", seed=0)
    settings = {"a": {}, "b": {"noise": LogNoise(std_range_m=0.2)}, "c": {"likelihood": LikelihoodConfig("truncated")}}
    recording = RobotRecording(tmp_path / "log")
    for name, setting in settings.items():
        run = filter_recording(recording, RangeBearingConfig(particles=50, **setting))
        write_run(run, tmp_path / name, recording.sources())
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--seeds", "2", "--workers", "1"]) == 0
    assert "explains the recording better than" in capsys.readouterr().err.replace("\n", " ")
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "c"), "--seeds", "2", "--workers", "1"]) == 2
    assert "not a density" in capsys.readouterr().err
    shutil.copytree(tmp_path / "b", tmp_path / "d")
    config = tmp_path / "d" / "config.yaml"
    config.write_text(config.read_text().replace("/log", "/other"))
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "d")]) == 2
    assert "different recordings" in capsys.readouterr().err
    config.write_text(config.read_text().replace("range-bearing", "mono"))
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "d")]) == 2
    assert "depends on where the filter looks" in capsys.readouterr().err
