"""Strict parsing: exact times, line numbers in every message, no other exception."""

import re

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import LogNoise
from rbpf.sensors.readers.text import read_columns, read_csv

COLUMNS = ("time", "x")


def table(tmp_path, text, columns=COLUMNS):
    file = tmp_path / "table.dat"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_columns(file, columns)


def test_times_keep_every_digit(tmp_path):
    rows = ["-1.5 0", "-.5 0", "0.1 0", "+3. 0", "7 0", "1248444175.103 0", "1248444175.123456789 0"]
    stamps = table(tmp_path, "\n".join(rows) + "\n").stamps_ns()
    expected = [-1500000000, -500000000, 100000000, 3000000000, 7000000000, 1248444175103000000]
    assert stamps.tolist() == [*expected, 1248444175123456789]


def test_digits_beyond_the_nanosecond_are_dropped(tmp_path):
    assert table(tmp_path, "1.0000000019 0\n").stamps_ns().tolist() == [1000000001]


def test_comments_blank_lines_line_ends_and_byte_order_mark_are_passed_over(tmp_path):
    read = table(tmp_path, b"\xef\xbb\xbf# a b\r\n\r\n 1 \t 2\r\n  # c\r\n3 -4e-1\r\n")
    np.testing.assert_array_equal(read.values, [[1, 2], [3, -0.4]])
    assert read.lines == [3, 5]


def test_csv_reports_which_header_it_found(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("a, c\n1, 2\n")
    read = read_csv(file, [("a", "b"), ("a", "c")])
    assert read.columns == ("a", "c")
    np.testing.assert_array_equal(read["c"], [2])


@pytest.mark.parametrize(
    ("second_line", "expected"),
    [
        ("2", "expected 2 columns (time, x), found 1"),
        ("2 3 4", "expected 2 columns (time, x), found 3"),
        ("2 nan", "expected x to be a finite number, found 'nan'"),
        ("2 inf", "expected x to be a finite number, found 'inf'"),
        ("2 0x1p3", "finite number, found '0x1p3'"),
        ("2 1_000", "finite number, found '1_000'"),
        ("2 1,5", "finite number, found '1,5'"),
        ("2 ٣", "finite number"),
        ("2 --3", "finite number, found '--3'"),
        ("2 5 # five", "found 4"),
        ("2 1e999", "expected x to be at most 1e+12 in size"),
        ("2 " + "9" * 400, "expected x to be at most 1e+12 in size"),
        ("2 \x00", "finite number"),
    ],
)
def test_a_malformed_row_is_named(tmp_path, second_line, expected):
    with pytest.raises(InputError, match=re.escape("table.dat, line 2: ")) as caught:
        table(tmp_path, f"1 2\n{second_line}\n3 4\n")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "table.dat: the file is empty"),
        (b" \n\n", "table.dat: the file is empty"),
        (b"# only\n", "expected rows of time, x, found none"),
        (b"1 2\n3 4", "table.dat, line 2: the file ends inside this line"),
        (b"1 2\n\xff\xfe\n", "table.dat, line 2: expected text in UTF-8"),
    ],
)
def test_a_file_that_is_no_table_is_named(tmp_path, text, message):
    with pytest.raises(InputError, match=re.escape(message)):
        table(tmp_path, text)


def test_a_missing_file_and_a_folder_in_its_place(tmp_path):
    with pytest.raises(InputError, match=r"none\.dat: no such file; expected the log of a robot\."):
        read_columns(tmp_path / "none.dat", COLUMNS, "the log of a robot")
    with pytest.raises(InputError, match="cannot be read"):
        read_columns(tmp_path, COLUMNS)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1.5 0\n1.499 0\n", "line 2: time runs backwards from 1.5 to 1.499"),
        ("1 0\n2e0 0\n", "line 2: expected a time such as 1248444175.103, found '2e0'"),
        ("5e9 0\n", "line 1: expected time to be within 4e+09 s of zero"),
    ],
)
def test_times_that_are_none(tmp_path, rows, message):
    with pytest.raises(InputError, match=re.escape(message)):
        table(tmp_path, rows).stamps_ns()


def test_whole_and_distinct_numbers(tmp_path):
    read = table(tmp_path, "1 2\n\n1 2.5\n")
    with pytest.raises(InputError, match=re.escape("line 3: expected x to be a whole number, found 2.5")):
        read.integers("x")
    with pytest.raises(InputError, match=re.escape("line 3: time 1 comes a second time")):
        read.names("time")


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf, 1e13])
def test_noise_must_be_positive(value):
    with pytest.raises(InputError, match="expected std_range_m to be positive"):
        LogNoise(std_range_m=value)


def test_noise_of_the_odometry_may_vanish():
    assert LogNoise(std_speed_mps=0.0, scale_odometry=0.0).odometry_variance_factor() == 0
    with pytest.raises(InputError, match="scale_odometry to be zero or positive"):
        LogNoise(scale_odometry=-1.0)
