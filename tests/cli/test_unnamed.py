"""A log that does not say which landmarks were observed."""

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.errors import InputError
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import RobotRecording
from rbpf.sensors.readers import open_log
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


@pytest.fixture
def log(tmp_path):
    simulate_robot(RobotWorld(12, 10, unnamed=True), tmp_path / "log", 0)
    return tmp_path / "log"


@pytest.mark.parametrize("column", [True, False])
def test_unnamed_observations_are_those_of_the_named_log(log, tmp_path, column):
    simulate_robot(RobotWorld(12, 10), tmp_path / "named", 0)
    if not column:
        table = log / "observations.csv"
        rows = [line.split(",") for line in table.read_text().splitlines()]
        table.write_text("".join(",".join([row[0], *row[2:]]) + "\n" for row in rows))
    for frame, named in zip(open_log(log).frames, open_log(tmp_path / "named").frames, strict=True):
        assert (frame.landmarks == -1).all() and frame.landmarks.size == named.landmarks.size
        np.testing.assert_array_equal(frame.z, named.z)


def test_names_are_needed_where_the_association_is_known(log):
    with pytest.raises(InputError, match="without a landmark's name: filter it with --association ml"):
        RobotRecording(log).open(RangeBearingConfig())


def test_an_unnamed_log_is_filtered(tmp_path):
    words = ["--steps", "12", "--landmarks", "10", "--unnamed"]
    assert main(["simulate", "range-bearing", "--out", str(tmp_path / "log"), *words]) == 0
    quick = ["--association", "ml", "--particles", "20", "--no-batch", "--out", str(tmp_path / "run")]
    assert main(["run", "range-bearing", str(tmp_path / "log"), *quick]) == 0
    found = RunFolder.open(tmp_path / "run")
    assert found.summary["landmarks"] == len(found.map.mean) > 3
