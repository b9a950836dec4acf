"""Graphs of odometry and landmark positions: conventions, bad input, the recording."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.readers import LogNoise, open_log
from tests.readers.fuzzing import is_log_or_one_sentence, pieces

QUARTER = np.pi / 2
GRAPH = f"""ODOMETRY 0 1 1 2 {QUARTER!r} 1 0.5 0.25 4 -0.75 9
LANDMARK 1 2 3 -4 0.5 0.1 0.25
ODOMETRY 1 3 1 0 0 1 0 0 0 0 1
LANDMARK 3 4 5 6 0.5 0 0.5
LANDMARK 1 4 7 8 0.5 0 0.5
LANDMARK 3 2 9 1 0.5 0 0.5
"""


def write(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def opened(path, noise=None):
    return open_log(path, noise)


@pytest.fixture
def graph(tmp_path):
    return write(tmp_path / "graph.txt", GRAPH)


def test_every_pose_is_a_frame(graph):
    log = opened(graph)
    assert (log.name, log.space, log.measurement, log.truth) == ("graph", SE2, "position", None)
    np.testing.assert_array_equal(log.robot_from_sensor, [0, 0, 0])
    assert [frame.stamp_ns for frame in log.frames] == [0, 1, 2]
    assert [frame.landmarks.tolist() for frame in log.frames] == [[], [2, 4], [4, 2]]
    np.testing.assert_array_equal(log.frames[1].z, [[3, -4], [7, 8]])
    np.testing.assert_array_equal(log.frames[1].cov_z[0], [[0.5, 0.1], [0.1, 0.25]])
    assert log.frames[0].delta is None
    np.testing.assert_allclose(log.frames[1].delta, [QUARTER, 1, 2])


def test_covariance_is_reordered_and_turned_into_the_body(graph):
    first, second = (frame.cov_delta for frame in opened(graph).frames[1:])
    np.testing.assert_allclose(first, [[9, -0.75, -0.25], [-0.75, 4, -0.5], [-0.25, -0.5, 1]], atol=1e-15)
    np.testing.assert_array_equal(second, np.diag([1, 1, 0]))


def test_given_noise_replaces_that_of_the_graph(graph):
    log = opened(graph, LogNoise(std_position_m=2.0, scale_odometry=3.0))
    np.testing.assert_array_equal(log.frames[1].cov_z[0], 4 * np.eye(2))
    np.testing.assert_array_equal(log.frames[2].cov_delta, np.diag([9, 9, 0]))
    with pytest.raises(InputError, match="std_range_m has no effect on a graph"):
        open_log(graph, LogNoise(std_range_m=1.0))


def test_a_folder_with_one_graph(graph):
    write(graph.parent / "notes.txt", "nothing\n")
    assert open_log(graph.parent).name == "graph"
    write(graph.parent / "other.txt", GRAPH)
    with pytest.raises(InputError, match=r"found 2; name one, such as .*graph\.txt\."):
        open_log(graph.parent)


@pytest.mark.parametrize(
    ("line", "text", "expected"),
    [
        (2, "LANDMRK 1 2 3 -4 0.5 0.1 0.25", "expected ODOMETRY or LANDMARK, found 'LANDMRK'"),
        (2, "LANDMARK", "expected numbers after LANDMARK, found none"),
        (2, "LANDMARK 1 2 3 -4 0.5 0.1", "expected 7 columns (pose, landmark, x, y, cxx, cxy, cyy), found 6"),
        (2, "LANDMARK 1 2 3 nan 0.5 0.1 0.25", "expected y to be a finite number, found 'nan'"),
        (2, "LANDMARK 1 2 3 -4 0.5 0.5 0.25", "expected cxx to cyy to be a covariance"),
        (2, "LANDMARK 8 2 3 -4 0.5 0.1 0.25", "expected pose to be a pose of the odometry, found 8"),
        (
            2,
            "LANDMARK 1 3 3 -4 0.5 0.1 0.25",
            "expected landmark to be a landmark's number, not a pose's, found 3",
        ),
        (2, "LANDMARK 1 2.5 3 -4 0.5 0.1 0.25", "expected landmark to be a whole number, found 2.5"),
        (5, "LANDMARK 1 2 7 8 0.5 0 0.5", "landmark 2 comes a second time in pose 1"),
        (
            3,
            "ODOMETRY 2 3 1 0 0 1 0 0 0 0 1",
            "expected odometry from pose 1, where the one before ends, found 2",
        ),
        (3, "ODOMETRY 1 1 1 0 0 1 0 0 0 0 1", "to 1 comes a second time"),
        (3, "ODOMETRY 1 0 1 0 0 1 0 0 0 0 1", "expected a path without loops, found a return to pose 0"),
        (3, "ODOMETRY 1 3 1 0 0 1 0 0 -1 0 1", "expected cxx to ctt to be a covariance"),
        (3, "ODOMETRY 1 99999999999999999999 1 0 0 1 0 0 0 0 1", "expected to to be at most 1e+12"),
    ],
)
def test_a_malformed_line_is_named(graph, line, text, expected):
    rows = GRAPH.split("\n")
    rows[line - 1] = text
    write(graph, "\n".join(rows))
    with pytest.raises(InputError, match=re.escape(f"graph.txt, line {line}: {expected}")):
        open_log(graph)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GRAPH[:-3], "graph.txt, line 6: the file ends inside this line"),
        (GRAPH.encode() + b"\xff\n", "graph.txt, line 7: expected text in UTF-8"),
        (
            "ODOMETRY 0 1 1 0 0 1 0 0 0 0 1\n",
            "expected rows of pose, landmark, x, y, cxx, cxy, cyy, found none",
        ),
        ("LANDMARK 1 2 3 -4 0.5 0.1 0.25\n", "expected rows of from, to, dx, dy, dtheta"),
    ],
)
def test_an_incomplete_graph(graph, text, message):
    with pytest.raises(InputError, match=re.escape(message)):
        open_log(write(graph, text))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("graph") / "graph.txt"


@given(start=st.integers(0, len(GRAPH)), length=st.integers(0, 12), piece=pieces(b" ", b"ODOMETRY"))
def test_any_mutation_gives_a_log_or_one_sentence(scratch, start, length, piece):
    text = GRAPH.encode()
    assert is_log_or_one_sentence(write(scratch, text[:start] + piece + text[start + length :]))


@given(data=st.binary(max_size=200))
def test_garbage_is_refused(scratch, data):
    with pytest.raises(InputError, match=re.escape(str(scratch))):
        open_log(write(scratch, data))


@pytest.mark.real_data
def test_recording(data_dir):
    log = opened(data_dir / "victoria_park")
    assert len(log.frames) == 6969
    assert sum(len(frame.z) for frame in log.frames) == 3640
    names = {name for frame in log.frames for name in frame.landmarks.tolist()}
    assert len(names) == 151
    assert len(log.frames) + len(names) == 7120
    np.testing.assert_array_equal(log.frames[4].landmarks, [5])
    np.testing.assert_allclose(log.frames[4].z, [[11.5387, -3.2007]])
    np.testing.assert_allclose(log.frames[1].cov_delta, np.diag([4e-6, 1e-4, 4e-6]), atol=1e-9)
    assert open_log(data_dir / "victoria_park" / "victoria_park.txt").name == "victoria_park"
