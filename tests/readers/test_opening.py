"""Recognition of a log's kind."""

import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import open_log


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such file or folder; expected a robot log"):
        open_log(tmp_path / "nowhere")


@pytest.mark.parametrize("path", ["\0", "x" * 5000])
def test_a_path_that_cannot_be(path):
    with pytest.raises(InputError, match="expected a robot log"):
        open_log(path)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([], "found an empty folder, expected an MRPT log"),
        (["b.png", "a.csv"], "found a folder with a.csv, b.png, expected"),
        (list("gfedcba"), "found a folder with a, b, c, d, e and more, expected"),
    ],
)
def test_a_folder_of_another_kind(tmp_path, names, found):
    for name in names:
        (tmp_path / name).write_text("something\n")
    with pytest.raises(InputError, match=found):
        open_log(str(tmp_path))


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "found an empty file"),
        (b"\x00\xff\x01", r"found a file that begins with '\\x00"),
        (b"timestamp tx ty\n1 2 3\n", "found a file that begins with 'timestamp tx ty', expected"),
    ],
)
def test_a_file_of_another_kind(tmp_path, content, found):
    file = tmp_path / "some.txt"
    file.write_bytes(content)
    with pytest.raises(InputError, match=found) as caught:
        open_log(file)
    for kind in ("MRPT", "MRCLAM", "ODOMETRY"):
        assert kind in str(caught.value)
