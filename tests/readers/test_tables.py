"""Tables of numbers, strictly parsed: exact times, line numbers in every message; and what single tables mean."""

import re

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers import read_known_points
from rbpf.sensors.readers.text import read_columns, read_csv
from rbpf.sensors.readers.wheel_odometry import read_wheel_odometry
from tests.readers.small import KNOWN, WHEELS, write

COLUMNS = ("time", "x")


def table(tmp_path, text, columns=COLUMNS):
    return read_columns(write(tmp_path, {"table.dat": text}) / "table.dat", columns)


def test_times_keep_every_digit_up_to_the_nanosecond(tmp_path):
    rows = ["-1.5 0", "-.5 0", "0.1 0", "+3. 0", "7 0", "1248444175.103 0", "1248444175.1234567899 0"]
    stamps = table(tmp_path, "\n".join(rows) + "\n").stamps_ns()
    expected = [-1500000000, -500000000, 100000000, 3000000000, 7000000000, 1248444175103000000]
    assert stamps.tolist() == [*expected, 1248444175123456789]


def test_comments_blank_lines_line_ends_and_byte_order_mark_are_passed_over(tmp_path):
    read = table(tmp_path, b"\xef\xbb\xbf# a b\r\n\r\n 1 \t 2\r\n  # c\r\n3 -4e-1\r\n")
    np.testing.assert_array_equal(read.values, [[1, 2], [3, -0.4]])
    assert read.lines == [3, 5]


def test_csv_reports_which_header_it_found(tmp_path):
    read = read_csv(write(tmp_path, {"table.csv": "a, c\n1, 2\n"}) / "table.csv", [("a", "b"), ("a", "c")])
    assert read.columns == ("a", "c")
    np.testing.assert_array_equal(read["c"], [2])


ROWS = [
    ("2", "expected 2 columns (time, x), found 1"),
    ("2 3 4", "expected 2 columns (time, x), found 3"),
    ("2 nan", "expected x to be a finite number, found 'nan'"),
    ("2 0x1p3", "expected x to be a finite number, found '0x1p3'"),
    ("2 1_000", "expected x to be a finite number, found '1_000'"),
    ("2 1,5", "expected x to be a finite number, found '1,5'"),
    ("2 ٣", "expected x to be a finite number, found '٣'"),
    ("2 5 # five", "expected 2 columns (time, x), found 4"),
    ("2 1e999", "expected x to be at most 1e+12 in size"),
    ("2 \x00", "expected x to be a finite number"),
]
TEXTS = [
    *((f"1 2\n{row}\n3 4\n", f"table.dat, line 2: {words}") for row, words in ROWS),
    (b"", "table.dat: the file is empty"),
    (b" \n\n", "table.dat: the file is empty"),
    (b"\xef\xbb\xbf\n", "table.dat: the file is empty"),
    (b"# only\n", "expected rows of time, x, found none"),
    (b"1 2\n\xff\xfe\n", "table.dat, line 2: expected text in UTF-8"),
    (b"1.5 0\n1.499 0\n", "line 2: time runs backwards from 1.5 to 1.499"),
    (b"5e9 0\n", "line 1: expected the time in seconds, within 4e+09 of zero"),
]


@pytest.mark.parametrize(("text", "message"), TEXTS)
def test_a_malformed_row_and_a_file_that_is_no_table_are_named(tmp_path, text, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        table(tmp_path, text).stamps_ns()
    assert "\n" not in str(caught.value)


def test_whole_and_distinct_numbers(tmp_path):
    read = table(tmp_path, "1 2\n\n1 2.5\n")
    with pytest.raises(InputError, match=re.escape("line 3: expected x to be a whole number, found 2.5")):
        read.integers("x")
    with pytest.raises(InputError, match=re.escape("line 3: time 1 comes a second time")):
        read.names("time")


def test_known_points(tmp_path):
    points = read_known_points(write(tmp_path, KNOWN) / "known_points.csv")
    assert points.names.tolist() == [7, 3] and points.names.dtype == np.int64
    assert points.px.tolist() == [[1.5, 2.5], [4, 5]]
    assert points.positions.tolist() == [[1, 2, 3], [-1, -2, -3]]
    assert points.std_m.tolist() == [0.1, 0.0]
    text = "# corners\r\nnote,sigma_m,v_px,u_px,z_m,y_m,x_m,id\r\n\r\n# first\r\ndoor,0.1,2,1,5,4,3,9\r\n"
    points = read_known_points(str(write(tmp_path, {"known_points.csv": text}) / "known_points.csv"))
    assert (points.names.tolist(), points.px.tolist(), points.std_m.tolist()) == ([9], [[1, 2]], [0.1])
    assert points.positions.tolist() == [[3, 4, 5]]


def test_wheel_odometry(tmp_path):
    odometry = read_wheel_odometry(write(tmp_path, WHEELS))
    assert odometry.stamps_ns.tolist() == [100, 200, 300]
    np.testing.assert_allclose(odometry.delta, [[np.pi / 2, 1.0, 0.0], [0.0, 2.0, 0.5]])
    np.testing.assert_allclose(odometry.std, [[0.3, 0.1, 0.2]] * 2)
    # One metre ahead, a quarter turn to the left, two metres ahead and half a metre to the left.
    path = [[0, 0, 0], [np.pi / 2, 1, 0], [np.pi / 2, 0.5, 2]]
    np.testing.assert_allclose(odometry.world_from_robot(), path)
    # The camera is carried by the robot.
    start = SE3.exp([0.1, -0.4, 0.3, 1.0, 2.0, 3.0])
    poses = odometry.world_from_camera(start)
    np.testing.assert_allclose(poses[0], start, atol=1e-12)
    np.testing.assert_allclose(SE3.translation(SE3.between(poses[0], poses[2])), [0.5, 2.0, 0.0], atol=1e-12)
