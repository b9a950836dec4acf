"""Tables of known points."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import read_known_points

HEADER = "id,u_px,v_px,x_m,y_m,z_m,sigma_m"


def write(tmp_path, text):
    path = tmp_path / "known_points.csv"
    path.write_bytes(text.encode())
    return path


def test_points(tmp_path):
    points = read_known_points(write(tmp_path, f"{HEADER}\n7,1.5,2.5,1,2,3,0.1\n3,4,5,-1,-2,-3,0\n"))
    assert points.names.tolist() == [7, 3] and points.names.dtype == np.int64
    assert points.px.tolist() == [[1.5, 2.5], [4, 5]]
    assert points.positions.tolist() == [[1, 2, 3], [-1, -2, -3]]
    assert points.std_m.tolist() == [0.1, 0.0]


def test_other_columns_another_order_comments_and_other_ends_of_lines(tmp_path):
    text = "# corners\r\nnote,sigma_m,v_px,u_px,z_m,y_m,x_m,id\r\n\r\n# first\r\ndoor,0.1,2,1,5,4,3,9\r\n"
    points = read_known_points(str(write(tmp_path, text)))
    assert points.names.tolist() == [9]
    assert points.px.tolist() == [[1, 2]]
    assert points.positions.tolist() == [[3, 4, 5]]
    assert points.std_m.tolist() == [0.1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "known_points.csv: the file is empty; expected a table with the columns id,"),
        ("# only\n", "line 1: expected a header with the columns id,u_px"),
        (
            "id,u_px,v_px,x_m,y_m,z_m\n1,2,3,4,5,6\n",
            "line 1: expected a header with the columns .*, found 'id,u_px",
        ),
        (f"{HEADER},id\n1,2,3,4,5,6,7,8\n", "line 1: expected a header with the columns .*, each once"),
        (f"{HEADER}\n", "expected rows of id, u_px, .* found none"),
        (f"{HEADER}\n1,2,3,4,5,6\n", "line 2: expected 7 columns as in the header, found 6"),
        (f"{HEADER}\n1,2,3,4,5,6,7,8\n", "line 2: expected 7 columns as in the header, found 8"),
        (f"{HEADER}\n1,2,3,4,5,6,0.1\n1,2,3,4,5,6,0.1\n", "line 3: id 1 comes a second time"),
        (f"{HEADER}\n1.5,2,3,4,5,6,0.1\n", "line 2: expected id to be a whole number, found 1.5"),
        (f"{HEADER}\n1,2,3,4,nan,6,0.1\n", "line 2: expected y_m to be a finite number, found 'nan'"),
        (f"{HEADER}\n1,2,3,4,5,6,-0.1\n", "line 2: expected sigma_m to be zero or positive, found -0.1"),
        (f"{HEADER}\n1,2,3,4,5,6,0.1", "line 2: the file ends inside this line"),
    ],
)
def test_a_malformed_table(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_known_points(write(tmp_path, text))
