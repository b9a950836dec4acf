"""`rbpf simulate lab` from end to end, on a few tiny images."""

from pathlib import Path

import numpy as np
import pytest

from rbpf.cli import main
from rbpf.sensors.readers import open_images, open_stereo, read_known_points
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry

pytestmark = pytest.mark.slow

SMALL = ["--width", "96", "--height", "72", "--texel-m", "0.05"]


def lab(out: Path, *arguments: str) -> int:
    return main(["simulate", "lab", "--out", str(out), *SMALL, *arguments])


def test_a_tour_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lab(tmp_path / "lab", "--every", "1000", "--noise-std", "0") == 0
    sequence = open_stereo(tmp_path / "lab")
    assert sequence.truth is not None
    assert len(sequence) == 4 and sequence.baseline_m == 0.12
    assert sequence.camera.fx == 75.0
    assert len(read_wheel_odometry(tmp_path / "lab").stamps_ns) == 3001
    assert read_known_points(tmp_path / "lab" / "known_points.csv").names.size == 6
    places = sequence.truth.poses[:, 4:]
    assert np.ptp(places, axis=0)[0] > 4.0 and np.ptp(places, axis=0)[2] < 1e-9
    said = " ".join(capsys.readouterr().err.split())
    assert f"wrote {tmp_path / 'lab'}" in said.replace("lab,", "lab") and "MB" in said


def test_options_reach_the_images(tmp_path: Path) -> None:
    options = ["--trajectory", "turn_back", "--frames", "3", "--known", "0", "--jpeg", "80", "--focal-px", "60"]
    assert lab(tmp_path / "mono", *options, "--baseline-m", "None") == 0
    sequence = open_images(tmp_path / "mono")
    assert len(sequence) == 3 and sequence.camera.fx == 60.0 and sequence.baseline_m is None
    assert {path.suffix for path in (tmp_path / "mono" / "mav0" / "cam0" / "data").iterdir()} == {".jpg"}
