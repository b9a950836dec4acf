"""Photos with measured poses."""

import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers import open_images
from tests.readers.images.folders import levels, write_camera, write_images

CAMERAS = "# K fx fy cx cy width height\nK 20 21 11.5 7.5 24 16\nb.jpg 1 2 3 0 0 0 1\na.jpg 4 5 6 0 0 1 0\n"


def write_photos(folder, cameras=CAMERAS):
    write_images(folder / "images", ["a.jpg", "b.jpg"])
    (folder / "cameras.txt").write_text(cameras)
    return folder


def test_photos_in_the_order_of_their_lines(tmp_path):
    sequence = open_images(write_photos(tmp_path / "well"))
    assert sequence.name == "well"
    assert sequence.stamps_ns.tolist() == [0, 1_000_000_000] == sequence.truth.stamps_ns.tolist()
    assert sequence.truth.world_from_camera.tolist() == [[0, 0, 0, 1, 1, 2, 3], [0, 0, 1, 0, 4, 5, 6]]
    assert sequence.camera.fy == 21.0
    assert levels(sequence) == [20, 10]
    assert open_images(tmp_path / "well", write_camera(tmp_path, fy=30.0)).camera.fy == 30.0


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ("a.jpg 4 5 6 0 0 1 0\n", "cameras.txt: expected one line `K fx fy cx cy width height`, found 0"),
        (CAMERAS + "K 20 21 11.5 7.5 24 16\n", "cameras.txt: expected one line `K .*`, found 2"),
        (CAMERAS.replace("K 20", "K -20"), "cameras.txt, line 2: expected positive fx and fy"),
        (CAMERAS.replace("24 16", "24 16.5"), "cameras.txt, line 2: .* a whole positive width and height"),
        (CAMERAS.replace("24 16", "48 32"), "cameras.txt, line 2: width and height are 48x32, the images of"),
        (CAMERAS.replace("24 16", "24"), "cameras.txt, line 2: expected 6 columns"),
        (CAMERAS.replace("4 5 6 0 0", "4 5 6 0"), "cameras.txt, line 4: expected 7 columns"),
        (CAMERAS.replace("0 0 1 0", "0 0 2 0"), "cameras.txt, line 4: expected a quaternion of length 1"),
        ("K 20 21 11.5 7.5 24 16\n", "cameras.txt: expected rows of tx, .* found none"),
    ],
)
def test_a_malformed_list(tmp_path, cameras, message):
    with pytest.raises(InputError, match=message):
        open_images(write_photos(tmp_path, cameras))
