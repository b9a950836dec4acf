"""Part of a robot's log: fewer frames, with the odometry between them composed."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import part_of_log
from rbpf.sensors.readers import Part
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot, simulated_log

WORLD = RobotWorld(12, 20, std_translation_m=0.2, std_rotation_deg=10.0)


@pytest.mark.parametrize("timed", [False, True], ids=["steps", "seconds"])
def test_odometry_is_composed_with_its_covariance(timed):
    """Against draws of each motion's noise."""
    log = simulated_log(WORLD, 0)
    if timed:
        frames = [replace(frame, stamp_ns=5 * 10**9 + frame.stamp_ns * 10**9) for frame in log.frames]
        log = replace(log, frames=frames)
    part = part_of_log(log, Part(2.0, 10.0, 3))
    assert [frame.stamp_ns for frame in part.frames] == [log.frames[t].stamp_ns for t in (2, 5, 8)]
    assert part.frames[0].delta is None and part.frames[0].cov_delta is None
    rng = np.random.default_rng(0)
    for number, last in ((1, 5), (2, 8)):
        np.testing.assert_array_equal(part.frames[number].z, log.frames[last].z)
        exact, noisy = SE2.identity(), SE2.identity()
        for frame in log.frames[last - 2 : last + 1]:
            exact = SE2.compose(exact, frame.delta)
            noise = rng.multivariate_normal(np.zeros(3), 1e-4 * frame.cov_delta, 100_000)
            noisy = SE2.compose(noisy, SE2.retract(frame.delta, noise))
        np.testing.assert_allclose(part.frames[number].delta, exact, atol=1e-12)
        cov = np.cov(SE2.local(exact, noisy).T) / 1e-4
        np.testing.assert_allclose(part.frames[number].cov_delta, cov, atol=0.02 * np.abs(cov).max())


def test_nothing_left():
    with pytest.raises(InputError, match=r"no frame is left from 12 s on: the recording is 11\.000 s long"):
        part_of_log(simulated_log(WORLD, 0), Part(12.0))


@pytest.mark.slow
def test_a_part_is_run_repeated_and_compared(tmp_path, capsys):
    simulate_robot(RobotWorld(12, 20), tmp_path / "log", 0)
    words = ["run", "range-bearing", str(tmp_path / "log"), "--particles", "5", "--no-batch", "--out"]
    assert main([*words, str(tmp_path / "part"), "--start", "2", "--every", "3"]) == 0
    assert main(["run", "--from", str(tmp_path / "part" / "config.yaml"), "--out", str(tmp_path / "again")]) == 0
    assert main([*words, str(tmp_path / "whole")]) == 0
    once, again = (RunFolder.open(tmp_path / name).path.world_from_body for name in ("part", "again"))
    assert len(once) == 4
    np.testing.assert_array_equal(once, again)
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "part"), str(tmp_path / "whole"), "--seeds", "2"]) == 2
    assert "or parts of one" in capsys.readouterr().err.replace("\n", " ")
