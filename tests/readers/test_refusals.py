"""What every reader of tables refuses: a bad line, a missing file, an incomplete one; and what is of no format at all."""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.runs.trajectory import read_tum
from rbpf.sensors.readers import open_images, open_log, read_known_points
from rbpf.sensors.readers.laser import read_laser_log
from rbpf.sensors.readers.text import read_columns, read_csv
from rbpf.validation.metrics.relations import read_relations
from tests.readers.small import CARMEN, GRAPH, KNOWN, MOUNT, MRCLAM, MRPT, MRPT_IN_SPACE, write

TUM = {"path.tum": "# x\n0.5 1 2 3 0 0 0 1\n0.6 1 2 3 0 0 0 1\n"}
RELATIONS = {"some.relations": "0 1 1 0 0 0 0 0.5\n1 2 1 0 0 0 0 0.5\n"}
FORMATS = {
    "MRCLAM": (MRCLAM, open_log),
    "MRPT": (MRPT, open_log),
    "space": (MRPT_IN_SPACE, open_log),
    "graph": (GRAPH, lambda folder: open_log(folder / "graph.txt")),
    "CARMEN": (CARMEN, lambda folder: read_laser_log(folder / "robot.clf")),
    "path": (TUM, lambda folder: read_tum(folder / "path.tum")),
    "relations": (RELATIONS, lambda folder: read_relations(folder / "some.relations")),
    "known": (KNOWN, lambda folder: read_known_points(folder / "known_points.csv")),
}
every_format = pytest.mark.parametrize("name", FORMATS)

LINES = """
MRCLAM | Barcodes.dat | 3 | 3 5 | barcode 5 occurs twice
MRCLAM | Barcodes.dat | 3 | 2 14.5 | expected barcode to be a whole number
MRCLAM | Robot3_Odometry.dat | 3 | 100.3 0.2 | expected 3 columns (time, forward speed, turn rate), found 2
MRCLAM | Robot3_Odometry.dat | 3 | 99.9 0.2 1.0 | time runs backwards from 100.0 to 99.9
MRCLAM | Robot3_Measurement.dat | 4 | 100.5 14 0 0 | expected range to be positive, found 0
MRCLAM | Robot3_Measurement.dat | 4 | 100.5 14 2 30 | expected bearing to be in radians, within a turn, found 30
MRCLAM | Landmark_Groundtruth.dat | 3 | 6 3 4 0 0 | subject 6 occurs twice
MRCLAM | Landmark_Groundtruth.dat | 3 | 7 3 4 0 -1 | expected std of y to be zero or positive
MRPT | odometry.csv | 1 | step,x | expected the header
MRPT | odometry.csv | 3 | 1,1,0,0,1,0,0,1,0,1 | expected step to be one more than in the row before
MRPT | odometry.csv | 3 | 2,1,,0,1,0,0,1,0,1 | expected dy_m to be a finite number, found ''
MRPT | odometry.csv | 3 | 2,1,0,0,-1,0,0,1,0,1 | expected cxx to cpp to be a covariance
MRPT | observations.csv | 2 | -1,7,3,0.1,0,0.01,0.02,0 | expected step to be one with odometry, 0 to 3
MRPT | observations.csv | 3 | 2.5,8,4,0,0,0.03,0.04,0 | expected step to be a whole number, found 2.5
MRPT | observations.csv | 3 | 0,7,4,0,0,0.03,0.04,0 | landmark 7 occurs twice in step 0
MRPT | observations.csv | 3 | 3,8,4,0,0,0.03,0.04,0 | line 4: time runs backwards from step 3 to 2
MRPT | observations.csv | 3 | 0,8,0,0,0,0.03,0.04,0 | expected range_m to be positive, found 0
MRPT | observations.csv | 3 | 0,8,4,0,0.1,0.03,0.04,0 | expected pitch_rad to be 0, as the odometry is planar
MRPT | sensor.yaml | 2 | robot_from_sensor: 3 | expected the keys x_m, y_m
MRPT | sensor.yaml | 2 | MOUNT with x_m: 0.5x | expected x_m to be a finite number
MRPT | sensor.yaml | 2 | MOUNT with roll_deg: 5 | as the odometry is planar
MRPT | sensor.yaml | 3 | x: 1 | expected the keys robot_from_sensor, positive_pitch; also known: std; found 'x'
MRPT | sensor.yaml | 4 | positive_pitch: left | expected positive_pitch to be up or down, found 'left'
MRPT | robot_path_groundtruth.csv | 3 | 0,3,4,0,0,0,0 | expected step to be later
MRPT | landmarks_groundtruth.csv | 3 | 7,1,2,3 | id 7 occurs twice
graph | graph.txt | 2 | LANDMRK 1 2 3 -4 0.5 0.1 0.25 | expected ODOMETRY or LANDMARK, found 'LANDMRK'
graph | graph.txt | 2 | LANDMARK 1 2 3 -4 0.5 0.5 0.25 | expected cxx to cyy to be a covariance
graph | graph.txt | 2 | LANDMARK 8 2 3 -4 0.5 0.1 0.25 | expected pose to be a pose of the odometry, found 8
graph | graph.txt | 2 | LANDMARK 1 3 3 -4 0.5 0.1 0.25 | expected landmark to be a landmark's number, not a pose's,
graph | graph.txt | 5 | LANDMARK 1 2 7 8 0.5 0 0.5 | landmark 2 occurs twice in pose 1
graph | graph.txt | 3 | ODOMETRY 2 3 1 0 0 1 0 0 0 0 1 | expected odometry from pose 1, where the one before ends, fou
graph | graph.txt | 3 | ODOMETRY 1 0 1 0 0 1 0 0 0 0 1 | expected a path without loops, found a return to pose 0
CARMEN | robot.clf | 2 | PARAM robot_frontlaser_offset far | expected robot_frontlaser_offset to be a finite number
CARMEN | robot.clf | 3 | ODOM 0 0 0 | expected x, y, theta, 3 more numbers and a time, found 4 words
CARMEN | robot.clf | 4 | FLASER | expected the number of readings, found the end of the line
CARMEN | robot.clf | 4 | FLASER 0 0 0 0 0 0 0 10.1 | expected readings, found none
CARMEN | robot.clf | 4 | FLASER 9 1 2 3 4 5 0 0 0 0 0 0 10.1 | expected odometry's x, found the end of the line
CARMEN | robot.clf | 4 | FLASER 3 1 2 3 4 5 0 0 0 0 0 0 10.1 robot 0.1 | expected a time, a host and a time after 11 words
CARMEN | robot.clf | 4 | FLASER 99 1 2 3 4 5 0 0 0 0 0 0 10.1 | expected 99 readings and what follows them, found 12 words
CARMEN | robot.clf | 4 | FLASER 5 1 2 x 4 5 0 0 0 0 0 0 10.1 | expected readings to be numbers, found 'x'
CARMEN | robot.clf | 4 | FLASER 5 1 2 3 4 5 0 0 0 0 nan 0 10.1 | expected odometry's y to be a finite number, found 'nan'
CARMEN | robot.clf | 4 | FLASER 5 1 2 3 4 5 0 0 0 0 0 0 5e9 | expected the time in seconds, within 4e+09 of zero
CARMEN | robot.clf | 7 | FLASER 4 1 2 3 4 0 0 0 0 0 0 10.5 | expected 5 readings as in line 4, found 4 readings
CARMEN | robot.clf | 7 | FLASER 5 1 2 3 4 5 0 0 0 0 0 0 9.2 | the time runs backwards by 1.100 s, expected scans in order
path | path.tum | 3 | 0.6 1 2 3 0 0 1 | expected 8 columns (timestamp, tx, ty, tz, qx, qy, qz, qw), found 7
path | path.tum | 2 | 0.5 1 2 3 0 0 0 0.9 | expected a quaternion of length 1, found one of length 0.9
relations | some.relations | 2 | 0 1 1 0 0 0 0 | expected 8 columns (t1, t2, x, y, z, roll, pitch, yaw), found 7
relations | some.relations | 2 | 0 5e9 1 0 0 0 0 0 | expected the time in seconds
known | known_points.csv | 1 | id,u_px,v_px,x_m,y_m,z_m | expected a header with the columns id,u_px,v_px,x_m,y_m
known | known_points.csv | 3 | 7,2,3,4,5,6,0.1 | id 7 occurs twice
known | known_points.csv | 2 | 1,2,3,4,5,6,-0.1 | expected sigma_m to be zero or positive, found -0.1
"""
"""Format, file, number of the line, what stands there in place of what is right, and the words about it."""

FILES = [
    ("MRCLAM", {"Robot3_Measurement.dat": "100.1 63 3 0.1\n104.7 63 3 0.1\n"},
     "Robot3_Odometry.dat, line 6: the odometry ends 1.700 s before the last observation"),
    ("MRCLAM", {"Robot3_Odometry.dat": "9 1 0\n29 1 0\n"}, "Odometry.dat: the odometry's rows are 20 s apart: write"),
    ("MRCLAM", {"Robot3_Measurement.dat": "100.1 5 3 0.1\n"}, "Measurement.dat: expected observations of landmarks"),
    ("graph", {"graph.txt": GRAPH["graph.txt"].encode() + b"\xff\n"}, "graph.txt, line 7: expected text in UTF-8"),
    ("graph", {"graph.txt": "ODOMETRY 0 1 1 0 0 1 0 0 0 0 1\n"}, "expected rows of pose, landmark, x, y, cxx"),
    ("graph", {"graph.txt": "LANDMARK 1 2 3 -4 0.5 0.1 0.25\n"}, "expected rows of from, to, dx, dy, dtheta"),
    ("MRPT", {"sensor.yaml": '"\\UFFFFFFFF"'}, "sensor.yaml"),
    ("MRPT", {"sensor.yaml": f"%YAML {'1' * 5000}.1\n---\na: 1\n"}, "sensor.yaml"),
    ("CARMEN", {"robot.clf": "ODOM 0 0 0 0 0 0 1\n"}, "robot.clf: expected a CARMEN log (a text file with lines FLASER"),
    ("CARMEN", {"robot.clf": gzip.compress(CARMEN["robot.clf"].encode())[:-9]}, "packed by gzip and cut off"),
    ("CARMEN", {"robot.clf": b"\x1f\x8b" + bytes(20)}, "robot.clf: it is packed by gzip and damaged"),
    ("known", {"known_points.csv": ""}, "known_points.csv: the file is empty; expected a table with the columns id,"),
    ("known", {"known_points.csv": "id,u_px,v_px,x_m,y_m,z_m,sigma_m\n"}, "expected rows of id, u_px"),
]  # fmt: skip
"""Format, files in place of those that are right, and the words about them."""

MISSING = [
    ("MRCLAM", "Barcodes.dat", "no such file; expected an MRCLAM log"),
    ("MRCLAM", "Robot3_Odometry.dat", "no such file; expected an MRCLAM log"),
    ("MRCLAM", "Robot3_Measurement.dat", "expected an MRCLAM log"),
    *(("MRPT", name, "no such file; expected an MRPT log") for name in list(MRPT)[:3]),
    ("CARMEN", "robot.clf", "no such file or folder; expected a ROS bag"),
    ("path", "path.tum", "no such file"),
]
"""Format, the file that is not there, and the words about it."""


def refused(name: str, folder: Path, files: dict[str, str | bytes], words: str) -> None:
    """The files of a format, some of them replaced, are refused in one sentence that holds these words."""
    whole, read = FORMATS[name]
    write(folder, whole | files)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        read(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", LINES.strip().split("\n"))
def test_a_bad_line_is_named(tmp_path, case):
    name, file, line, text, words = case.split(" | ")
    if text.startswith("MOUNT with "):
        key, value = text.removeprefix("MOUNT with ").split(": ")
        text = re.sub(rf"{key}: [^,}}]*", f"{key}: {value}", MOUNT)
    rows = FORMATS[name][0][file].split("\n")
    rows[int(line) - 1] = text
    place = "" if words.startswith("line") else f"line {line}: "
    exact = not words.startswith(("found", "as the"))
    refused(name, tmp_path, {file: "\n".join(rows)}, f"{file}, {place}{words}" if exact else words)


@pytest.mark.parametrize(("name", "files", "words"), FILES)
def test_a_bad_file_is_named(tmp_path, name, files, words):
    refused(name, tmp_path, files, words)


@every_format
def test_a_file_that_ends_inside_a_line_is_named(tmp_path, name):
    for file, text in FORMATS[name][0].items():
        if not file.endswith(".yaml") and "calibration" not in file:
            words = f"{file}, line {text.count(chr(10))}: the file ends inside this line"
            refused(name, tmp_path, {file: text[:-2]}, words)


@pytest.mark.parametrize(("name", "file", "words"), MISSING)
def test_a_missing_file_is_named(tmp_path, name, file, words):
    files, read = FORMATS[name]
    write(tmp_path, {other: text for other, text in files.items() if other != file})
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        read(tmp_path)
    assert str(tmp_path) in str(caught.value)


KINDS = {
    open_log: ("MRPT", "MRCLAM", "ODOMETRY"),
    open_images: ("TUM", "EuRoC", "KITTI", "7-Scenes", "photos", "video", "a folder of images"),
}
OTHERS = [
    ({}, "", "found an empty folder"),
    ({"b.txt": "1", "a.csv": "1"}, "", "found a folder with a.csv, b.txt"),
    (dict.fromkeys("gfedcba", "1"), "", "found a folder with a, b, c, d, e and more"),
    ({}, "nowhere", ""),
    ({}, "\0", ""),
    ({}, "x" * 5000, ""),
]
"""Files of a folder, what of it is opened, and what is found there."""


@pytest.mark.parametrize(("files", "path", "found"), OTHERS)
@pytest.mark.parametrize("read", KINDS, ids=["log", "images"])
def test_what_is_of_no_format_is_told_from_what_is_expected(tmp_path, read, files, path, found):
    with pytest.raises(InputError, match=f"{found}.* expected") as caught:
        read(write(tmp_path, files) / path if path else str(write(tmp_path, files)))
    assert path or all(kind in str(caught.value) for kind in KINDS[read])


@pytest.mark.parametrize(
    ("read", "name", "content", "found"),
    [
        (open_log, "some.txt", b"", "found an empty file"),
        (open_log, "some.txt", b"\x00\xff\x01", r"found a file that begins with '\\x00.*'"),
        (open_log, "some.txt", b"timestamp tx ty\n1 2 3\n", "found a file that begins with 'timestamp tx ty'"),
        (open_images, "0.png", b"something", "found a file that begins with 'something'"),
    ],
)
def test_a_file_of_another_kind(tmp_path, read, name, content, found):
    with pytest.raises(InputError, match=f"{found}, expected"):
        read(write(tmp_path, {name: content}) / name)


# Tables of numbers, strictly parsed: exact times, line numbers in every message; and what single tables mean.

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
    with pytest.raises(InputError, match=re.escape("line 3: time 1 occurs twice")):
        read.names("time")


def test_known_points(tmp_path):
    points = read_known_points(write(tmp_path, KNOWN) / "known_points.csv")
    assert points.names.tolist() == [7, 3] and points.names.dtype == np.int64
    assert points.px.tolist() == [[1.5, 2.5], [4, 5]]
    assert points.positions.tolist() == [[1, 2, 3], [-1, -2, -3]]
    assert points.std_m.tolist() == [0.1, 0.0]
    assert points.across_m is None
    text = "# corners\r\nnote,across_m,sigma_m,v_px,u_px,z_m,y_m,x_m,id\r\n\r\n# 1\r\ndoor,0.05,0.1,2,1,5,4,3,9\r\n"
    points = read_known_points(str(write(tmp_path, {"known_points.csv": text}) / "known_points.csv"))
    assert (points.names.tolist(), points.px.tolist(), points.std_m.tolist()) == ([9], [[1, 2]], [0.1])
    assert points.positions.tolist() == [[3, 4, 5]] and points.across_m.tolist() == [0.05]
    with pytest.raises(InputError, match=re.escape("expected across_m to be from 0 to sigma_m / √2, found 0.09")):
        read_known_points(write(tmp_path, {"known_points.csv": text.replace("0.05", "0.09")}) / "known_points.csv")
