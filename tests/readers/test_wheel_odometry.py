"""Reader of wheel odometry: round trip, dead reckoning, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers.wheel_odometry import WheelOdometry, read_wheel_odometry
from rbpf.validation.simulation.paths import write_wheel_odometry

HEADER = "#stamp_ns,dx_m,dy_m,dyaw_rad,sigma_x_m,sigma_y_m,sigma_yaw_rad"
ROWS = ["100,0,0,0,0,0,0", "200,1.0,0.0,1.5707963267948966,0.1,0.2,0.3", "300,2,0.5,0,0.1,0.2,0.3"]
MOUNT = "robot_from_camera: [0, 0, 0, 1, 0, 0, 1.5]"


def folder(path: Path, rows: list[str] = ROWS, mount: str | None = MOUNT) -> Path:
    (path / "odometry.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    if mount is not None:
        (path / "odometry.yaml").write_text(mount + "\n")
    return path


def test_a_file_is_read_as_it_says(tmp_path: Path) -> None:
    odometry = read_wheel_odometry(folder(tmp_path))
    assert odometry.stamps_ns.tolist() == [100, 200, 300]
    np.testing.assert_allclose(odometry.delta, [[np.pi / 2, 1.0, 0.0], [0.0, 2.0, 0.5]])
    np.testing.assert_allclose(odometry.std, [[0.3, 0.1, 0.2]] * 2)
    # One metre ahead, a quarter turn to the left, two metres ahead and half a metre to the left.
    np.testing.assert_allclose(
        odometry.world_from_robot(), [[0, 0, 0], [np.pi / 2, 1, 0], [np.pi / 2, 0.5, 2]]
    )


def test_the_camera_is_carried_by_the_robot(tmp_path: Path) -> None:
    odometry = read_wheel_odometry(folder(tmp_path))
    start = SE3.exp([0.1, -0.4, 0.3, 1.0, 2.0, 3.0])
    poses = odometry.world_from_camera(start)
    np.testing.assert_allclose(poses[0], start, atol=1e-12)
    local = SE3.translation(SE3.between(poses[0], poses[2]))
    np.testing.assert_allclose(local, [0.5, 2.0, 0.0], atol=1e-12)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stamps = 1_400_000_000_000_000_000 + np.arange(20, dtype=np.int64) * 66_666_667
    delta, std = rng.normal(0.0, 0.1, (19, 3)), rng.uniform(0.0, 0.1, (19, 3))
    mount = SE3.exp(rng.normal(size=6))
    write_wheel_odometry(tmp_path, WheelOdometry(stamps, delta, std, mount))
    found = read_wheel_odometry(tmp_path)
    np.testing.assert_array_equal(found.stamps_ns, stamps)
    np.testing.assert_allclose(found.delta, delta, rtol=1e-8)
    np.testing.assert_allclose(found.std, std, rtol=1e-8)
    np.testing.assert_allclose(found.robot_from_camera, mount, atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "mount", "message"),
    [
        ([], MOUNT, "odometry.csv: expected lines that begin with a time"),
        ([*ROWS, "250,0,0,0,0,0,0"], MOUNT, "line 5: time runs backwards"),
        ([*ROWS, "300,0,0,0,0,0,0"], MOUNT, "line 5: expected a later time"),
        ([*ROWS, "400,0,0,0,0,0"], MOUNT, "line 5: expected 6 columns"),
        ([*ROWS, "400,0,nan,0,0,0,0"], MOUNT, "line 5: expected dy_m to be a finite number"),
        ([*ROWS, "400,0,0,0,0,-1,0"], MOUNT, "line 5: expected sigma_y_m to be zero or positive"),
        (ROWS[1:], MOUNT, "line 2: expected no motion on the first line"),
        (["1.5,0,0,0,0,0,0"], MOUNT, "line 2: expected a time in whole nanoseconds"),
        (ROWS, None, "odometry.yaml: no such file"),
        (ROWS, "other: 1", "found no robot_from_camera"),
        (ROWS, "robot_from_camera: [0, 0, 0, 1, 0, 0]", "expected robot_from_camera to be a list of 7"),
        (ROWS, "robot_from_camera: [0, 0, 0, 2, 0, 0, 0]", "unit quaternion"),
    ],
)
def test_what_is_wrong_is_named(rows: list[str], mount: str | None, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_wheel_odometry(folder(tmp_path, rows, mount))
    assert message in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"odometry.csv: no such file; expected the readings of a robot's wheels"
    ):
        read_wheel_odometry(tmp_path)
