"""Recordings of laser scanners: what lines and messages mean, and what is done about odd ones."""

import gzip
import logging

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers import Part
from rbpf.sensors.readers.laser import LaserOptions, read_laser_log
from rbpf.validation.simulation.laser import LaserWorld, simulate_laser
from tests.readers.images.bags import KINDS, STAMPS_NS, recorded, write_scans
from tests.readers.small import CARMEN, QUARTER, write

TEXT = CARMEN["robot.clf"]
LEFT_OUT, NOTHING = np.nan, np.inf
POSE = "0 0 0 0 0 0"


def log_of(folder, text, options=None, name="robot.clf"):
    return read_laser_log(write(folder, {name: text}) / name, options)


def test_a_carmen_log(tmp_path):
    log = log_of(tmp_path, TEXT)
    assert log.name == "robot"
    assert log.stamps_ns.tolist() == [10_100_000_000, 10_300_000_000, 10_400_000_000]
    np.testing.assert_array_equal(log.ranges[0], [1.0, LEFT_OUT, NOTHING, 2.5, LEFT_OUT])
    np.testing.assert_allclose(np.degrees(log.scanner.angles), [-90, -45, 0, 45, 90])
    assert log.scanner.max_range_m == 80.0
    # The two poses of each line are half a metre apart, ahead.
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(log.odometry, [[0, 0, 0], [QUARTER, 1, 0], [0, 1, 0]])
    packed = log_of(tmp_path, gzip.compress(TEXT.encode()), name="robot.clf.gz")
    assert packed.name == "robot"
    np.testing.assert_array_equal(packed.ranges, log.ranges)


@pytest.mark.parametrize(
    ("count", "first", "last"), [(180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50)]
)
def test_the_beams_of_usual_scanners(tmp_path, count, first, last):
    log = log_of(tmp_path, f"FLASER {count} {'2 ' * count}{POSE} 1.5\n")
    np.testing.assert_allclose(np.degrees(log.scanner.angles[[0, -1]]), [first, last])


def test_a_scanner_that_tells_its_beams(tmp_path):
    lines = [f"ROBOTLASER1 0 0.5 1 -0.25 20 0.01 0 3 1 20 5 2 7 8 {pose} 0 0 0 0 0 {t} host {t}\n"
             for t, pose in enumerate(["2 3 1.5 2 3 0", "3 3 1.5 3 3 0"])]  # fmt: skip
    log = log_of(tmp_path, "".join(lines))
    # Readings that run clockwise are put the other way round.
    np.testing.assert_allclose(log.scanner.angles, [0.0, 0.25, 0.5])
    np.testing.assert_array_equal(log.ranges[0], [5, NOTHING, 1])
    assert log.scanner.max_range_m == 20.0
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [1.5, 0, 0])
    # One that is mounted upside down sees the mirror image.
    turned = log_of(tmp_path, "".join(lines), LaserOptions(upside_down=True, max_range_m=4.0))
    np.testing.assert_allclose(turned.scanner.angles, [-0.5, -0.25, 0.0])
    np.testing.assert_array_equal(turned.ranges[0], [1, NOTHING, NOTHING])
    with pytest.raises(InputError, match=r"line 1: expected beams in radians, within a turn, found 3 from 90 on"):
        log_of(tmp_path, lines[0].replace("0.5 1 -0.25", "90 180 -1"))


def test_odometry_of_its_own_lines_is_interpolated(tmp_path, caplog):
    scans = [f"RAWLASER1 0 -1 2 1 30 0 0 3 1 2 3 0 {t} host {t}\n" for t in (0.5, 1.5, 2.5, 9.0)]
    odometry = [f"ODOM {t} 0 {0.2 * t} 1 0 0 {t} host {t}\n" for t in (3.0, 1.0, 2.0)]
    parameters = "PARAM robot_frontlaser_offset 0.3\nPARAM robot_frontlaser_angular_offset 0.1\n"
    log = log_of(tmp_path, parameters + "".join([*scans, *odometry]))
    assert log.stamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
    expected = SE2.compose([0.2, 1, 0], SE2.exp(SE2.local(np.array([0.2, 1, 0]), np.array([0.4, 2, 0])) / 2))
    np.testing.assert_allclose(log.odometry[0], expected)
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0.1, 0.3, 0])
    assert "left out 2 scans before the odometry begins or after it ends" in caplog.text
    assert log_of(tmp_path, "".join(scans)).odometry is None
    with pytest.raises(InputError, match="have no time in common"):
        log_of(tmp_path, scans[0] + odometry[0])


def test_a_corrected_path_is_not_where_the_scanner_sits(tmp_path):
    corrected = "".join(f"FLASER 1 2 {t} {t % 3} 0 {t} 0 0 {t} host\n" for t in range(4))
    log = log_of(tmp_path, "PARAM robot_frontlaser_offset 0.25\n" + corrected)
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0, 0.25, 0])


def test_the_second_scanner_by_its_name(tmp_path, caplog):
    both = TEXT + "RLASER 1 4 0 0 3.0 0 0 0 10.5 host\n"
    assert log_of(tmp_path, both).ranges.shape == (3, 5)
    assert "the scans are those of FLASER, of FLASER, RLASER" in caplog.text
    rear = log_of(tmp_path, both, LaserOptions("RLASER"))
    assert rear.ranges.tolist() == [[4.0]]
    np.testing.assert_allclose(rear.scanner.robot_from_sensor, [3.0, 0, 0])
    with pytest.raises(InputError, match="expected scans called ROBOTLASER1, found FLASER"):
        log_of(tmp_path, TEXT, LaserOptions("ROBOTLASER1"))


def test_scans_that_come_late_are_left_out_and_odometry_that_jumps_is_kept(tmp_path, caplog):
    times = [1.0, 1.4, 1.2, 1.4, 1.5]
    log = log_of(tmp_path, "".join(f"FLASER 1 {k + 1} {POSE} {t}\n" for k, t in enumerate(times)))
    assert log.ranges[:, 0].tolist() == [1, 2, 5]
    assert "left out 2 scans whose time is not after that of the scan before" in caplog.text
    lines = "".join(f"FLASER 1 2 0 0 0 {x} 0 0 {t}.0\n" for t, x in enumerate([0, 0.5, 100.5, 101]))
    assert log_of(tmp_path, lines).odometry[:, 1].tolist() == [0, 0.5, 100.5, 101]


def told_of_a_mirror(text, folder, caplog, **options) -> tuple[bool, ...]:
    """Whether a log is told of as it is, and with its readings the other way round."""
    told = []
    for name, order in (("plain.clf", 1), ("reversed.clf", -1)):
        lines = [line.split() for line in text.splitlines()]
        turned = [
            [*w[:2], *w[2 : 2 + int(w[1])][::order], *w[2 + int(w[1]) :]] if w[0] == "FLASER" else w for w in lines
        ]
        caplog.clear()
        log_of(folder, "".join(" ".join(words) + "\n" for words in turned), LaserOptions(**options), name)
        told.append("the scans rotate against the odometry" in caplog.text)
    return tuple(told)


def test_a_scanner_whose_readings_run_the_other_way_is_told(tmp_path, caplog):
    simulate_laser(LaserWorld(scans=150, laps=1), tmp_path, seed=1)
    text = (tmp_path / "robot.clf").read_text()
    assert told_of_a_mirror(text, tmp_path, caplog) == (False, True)
    assert told_of_a_mirror(text, tmp_path, caplog, upside_down=True) == (True, False)
    # Nothing turns: nothing can be told.
    straight = "".join(f"FLASER 3 2 {2 + x} 3 {x} 0 0 {x} 0 0 {t}.0\n" for t, x in enumerate(np.arange(20) * 0.2))
    assert told_of_a_mirror(straight, tmp_path, caplog) == (False, False)


@pytest.mark.parametrize(("largest", "reach"), [("8.191", 8.18), ("81.91", 80.0), ("7.5", 80.0)])
def test_no_return_in_the_codes_of_sick(tmp_path, largest, reach):
    log = log_of(tmp_path, f"FLASER 2 5.0 {largest} {POSE} 1\n")
    assert log.scanner.max_range_m == reach
    assert np.isinf(log.ranges[0, 1]) == (float(largest) >= reach)
    told = f"PARAM robot_front_laser_max 4.5\nFLASER 2 5.0 {largest} {POSE} 1\n"
    assert np.isinf(log_of(tmp_path, told).ranges).all()


def test_a_part_of_a_log(tmp_path):
    text = "".join(f"FLASER 1 {t + 1} {POSE} {t}\n" for t in range(10))
    log = log_of(tmp_path, text, LaserOptions(part=Part(start_s=2.0, end_s=7.0, every=3)))
    assert log.ranges[:, 0].tolist() == [3, 6] and len(log.odometry) == 2
    with pytest.raises(InputError, match="no scan is left from 20 s on: the recording is 9"):
        log_of(tmp_path, text, LaserOptions(part=Part(start_s=20.0)))


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("by_topic", [False, True])
def test_a_bag(tmp_path, name, by_topic):
    log = read_laser_log(write_scans(tmp_path / name, by_topic=by_topic))
    assert log.stamps_ns.tolist() == list(STAMPS_NS)
    np.testing.assert_array_equal(log.ranges[0], [1.0, LEFT_OUT, LEFT_OUT, NOTHING, NOTHING])
    np.testing.assert_allclose(log.scanner.angles, [-1, -0.5, 0, 0.5, 1])
    np.testing.assert_allclose(log.scanner.robot_from_sensor, [0, 0.2, 0])
    # The first scan is at the first reading, the others midway between two.
    np.testing.assert_allclose(log.odometry[:, 0], [0.0, 0.15, 0.25], atol=1e-3)


def test_a_scanner_upside_down_by_its_transform(tmp_path, caplog):
    """Turned about its x axis by half a turn, readings clockwise: the two undo each other."""
    usual = read_laser_log(write_scans(tmp_path / "usual.bag"))
    turned = read_laser_log(write_scans(tmp_path / "turned.bag", (1.0, 0.0, 0.0, 0.0), start=1.0, step=-0.5))
    np.testing.assert_allclose(turned.scanner.angles, usual.scanner.angles)
    np.testing.assert_array_equal(turned.ranges, usual.ranges)
    clockwise = read_laser_log(write_scans(tmp_path / "clockwise.bag", start=1.0, step=-0.5))
    np.testing.assert_array_equal(clockwise.ranges, usual.ranges[:, ::-1])
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


def test_bags_that_say_less(tmp_path, caplog):
    with recorded(tmp_path / "bare.bag") as bag:
        for stamp in STAMPS_NS:
            bag.scan("/scan", stamp, [1.0, 2.0], reach=(0.0, 0.0))
    log = read_laser_log(tmp_path / "bare.bag")
    assert log.odometry is None and log.scanner.max_range_m == 80.0
    assert "no mounting pose of the scanner" in caplog.text
    with pytest.raises(InputError, match=r"expected a topic /other, found /scan of LaserScan"):
        read_laser_log(tmp_path / "bare.bag", LaserOptions("/other"))
    with recorded(tmp_path / "uneven.bag") as bag:
        bag.scan("/scan", STAMPS_NS[0], [1.0, 2.0])
        bag.scan("/scan", STAMPS_NS[1], [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match=r"/scan, scan 1: expected beams as in the scans before"):
        read_laser_log(tmp_path / "uneven.bag")
    with pytest.raises(InputError, match=r"found a folder with bare.bag, uneven.bag, expected a ROS bag"):
        read_laser_log(tmp_path)


@pytest.mark.real_data
def test_a_recording_of_a_robot(data_dir):
    log = read_laser_log(data_dir / "laser_intel" / "intel.clf")
    assert log.ranges.shape == (910, 180) and np.isinf(log.ranges).sum() == 4172
    assert not np.isnan(log.ranges).any()
    assert np.nanmax(log.ranges[np.isfinite(log.ranges)]) < 30.0


@pytest.mark.real_data
def test_a_recording_of_a_robot_in_a_mirror(data_dir, tmp_path, caplog):
    text = (data_dir / "laser_intel" / "intel.clf").read_text()
    assert told_of_a_mirror("\n".join(text.splitlines()[:200]), tmp_path, caplog) == (False, True)
