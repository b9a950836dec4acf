"""Recognition of a sequence's kind."""

import subprocess
import sys

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import ImageSequence, open_images


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such file or folder; expected an image sequence"):
        open_images(tmp_path / "nowhere")


@pytest.mark.parametrize("path", ["\0", "x" * 5000])
def test_a_path_that_cannot_be(path):
    with pytest.raises(InputError, match="expected an image sequence"):
        open_images(path)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ([], "found an empty folder, expected a"),
        (["b.txt", "a.csv"], "found a folder with a.csv, b.txt, expected"),
        (
            [f"{letter}.txt" for letter in "gfedcba"],
            "found a folder with a.txt, b.txt, c.txt, d.txt, e.txt and more",
        ),
    ],
)
def test_a_folder_of_another_kind(tmp_path, names, found):
    for name in names:
        (tmp_path / name).write_text("something\n")
    with pytest.raises(InputError, match=found) as caught:
        open_images(tmp_path)
    for kind in ("TUM", "EuRoC", "KITTI", "7-Scenes", "photos", "video", "a folder of images"):
        assert kind in str(caught.value)


@pytest.mark.parametrize(
    ("name", "found"),
    [("0.png", "found a file that ends in '.png', expected"), ("list", "found a file, expected")],
)
def test_a_file_of_another_kind(tmp_path, name, found):
    (tmp_path / name).write_bytes(b"something")
    with pytest.raises(InputError, match=found):
        open_images(tmp_path / name)


def test_images_without_a_camera(tmp_path):
    (tmp_path / "0.png").write_bytes(b"something")
    with pytest.raises(
        InputError, match=r"camera.yaml: no such file; expected a camera.yaml with the keys fx"
    ):
        open_images(tmp_path)


def test_importing_the_readers_imports_no_image_library():
    code = "import sys, rbpf.sensors.readers.images; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (np.array([0.0, np.nan, 1.0]), "whole numbers"),
        (np.array([0, 5, 4]), "image 2 is before"),
        (np.zeros((3, 1), dtype=np.int64), "whole numbers"),
    ],
)
def test_stamps_that_are_none_or_run_backwards(stamps, words):
    """A sequence may be made by hand."""
    with pytest.raises(InputError, match=words):
        ImageSequence("by hand", None, stamps, None, None, None)
