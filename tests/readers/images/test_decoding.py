"""Images one after the other: lazily, in grey, and around those that cannot be read."""

import os
import time
import zlib
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest

from rbpf.core.checkpoint import load_arrays
from rbpf.errors import InputError
from rbpf.sensors.readers import open_images
from rbpf.sensors.readers.images import decoding
from rbpf.sensors.readers.yaml_files import read_plain_yaml
from tests.readers.images.folders import HEIGHT, SIZE, WIDTH, grey, levels, write_image, write_images, write_plain


def only_frame(folder):
    (frame,) = open_images(folder).frames()
    return frame


def test_colour_becomes_grey(tmp_path):
    write_plain(tmp_path, [])
    blue, green, red = 200, 100, 50
    write_image(tmp_path / "0.png", np.full((*SIZE, 3), (blue, green, red), np.uint8))
    image = only_frame(tmp_path).image
    assert image.dtype == np.uint8 and image.shape == SIZE
    assert abs(int(image[3, 4]) - (0.114 * blue + 0.587 * green + 0.299 * red)) <= 1
    write_image(tmp_path / "0.png", np.full((*SIZE, 4), (90, 90, 90, 10), np.uint8))  # transparency is passed over
    assert only_frame(tmp_path).image[0, 0] == 90


def test_sixteen_bits_are_scaled_to_eight(tmp_path):
    write_plain(tmp_path, [])
    deep = np.zeros(SIZE, np.uint16)
    deep[0, :4] = [0, 257, 32896, 65535]
    write_image(tmp_path / "0.png", deep)
    assert only_frame(tmp_path).image[0, :4].tolist() == [0, 1, 128, 255]


def encoded(image, suffix=".png", cut=0):
    data = cv2.imencode(suffix, image)[1].tobytes()
    return data[: len(data) - cut]


NOISE = np.random.default_rng(1).integers(0, 255, SIZE, dtype=np.uint8)
DAMAGED = "the file is damaged, incomplete or not an image."
LOST = [
    (None, "no such file."),
    (b"", "the file is empty, expected an image."),
    (b"\x89PNG\r\n\x1a\n", DAMAGED),
    *((encoded(NOISE, suffix, 150), DAMAGED) for suffix in (".png", ".jpg", ".tiff", ".pgm")),
    (encoded(grey(20, (HEIGHT, WIDTH + 2))), "expected 24x16 px as in the camera file, found 26x16 px"),
    (encoded(np.ones(SIZE, np.float32), ".tiff"), "expected 8 or 16 bits per channel, found float32"),
]


@pytest.mark.parametrize(("content", "problem"), LOST)
def test_an_image_that_cannot_be_read_is_a_lost_frame_that_says_why(tmp_path, content, problem):
    sequence = open_images(write_plain(tmp_path))
    (tmp_path / "1.png").unlink() if content is None else (tmp_path / "1.png").write_bytes(content)
    assert levels(sequence) == [10, None, 30]
    lost = list(sequence.frames())[1]
    assert lost.problem.startswith(f"{tmp_path / '1.png'}: ") and problem in lost.problem
    assert lost.stamp_ns == sequence.stamps_ns[1]


@pytest.mark.parametrize("damage", ["a part", "the size"])
def test_an_image_that_claims_more_than_it_has_takes_no_memory(tmp_path, damage):
    """A PNG of a few bytes, of which a part claims 4 GiB, or whose header 8,000 x 8,000 pixels."""
    write_plain(tmp_path)
    path = tmp_path / "1.png"
    content = bytearray(path.read_bytes())
    if damage == "a part":
        content[33:37] = b"\xff\xff\xff\xf0"
    else:
        content[16:24] = (8_000).to_bytes(4, "big") * 2
        content[29:33] = zlib.crc32(bytes(content[12:29])).to_bytes(4, "big")
    path.write_bytes(bytes(content))
    with mock.patch.object(cv2, "imdecode", side_effect=cv2.imdecode) as decoded:
        problem = list(open_images(tmp_path).frames())[1].problem
    assert decoded.call_count == 3  # the first one twice, and the third
    assert problem is not None and ("damaged" if damage == "a part" else "found 8000x8000 px") in problem


def test_pipes_and_devices_are_no_files(tmp_path):
    """They would be waited for, or read without end."""
    write_plain(tmp_path)
    for name in ("1.png", "pipe.yaml", "pipe.npz"):
        (tmp_path / name).unlink(missing_ok=True)
        os.mkfifo(tmp_path / name)
    assert "it is a device or a pipe, no file" in list(open_images(tmp_path).frames())[1].problem
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero")):
        with pytest.raises(InputError, match="it is a device or a pipe, no file"):
            read_plain_yaml(path)
    with pytest.raises(InputError, match="not a complete archive"):
        load_arrays(tmp_path / "pipe.npz")


def test_the_first_image_that_can_be_read_tells_the_size_and_reading_begins_at_any(tmp_path):
    write_plain(tmp_path)
    (tmp_path / "0.png").write_bytes(b"none")
    assert levels(open_images(tmp_path)) == [None, 20, 30]
    # From any image on, and more than once.
    sequence = open_images(write_plain(tmp_path / "twelve", [f"{i}.png" for i in range(12)]))
    everything = [10 * i + 10 for i in range(12)]
    assert levels(sequence) == everything == levels(sequence)
    assert levels(sequence, 7) == everything[7:]
    assert [frame.stamp_ns for frame in sequence.frames(11)] == [sequence.stamps_ns[11]]


def test_nothing_but_what_is_needed_is_decoded(tmp_path):
    write_plain(tmp_path, [f"{i:05d}.png" for i in range(1)])
    data = (tmp_path / "00000.png").read_bytes()
    for i in range(1, 1_000):
        (tmp_path / f"{i:05d}.png").write_bytes(data)
    with mock.patch.object(cv2, "imdecode", wraps=cv2.imdecode) as decoded:
        sequence = open_images(tmp_path)
        assert len(sequence) == 1_000
        assert decoded.call_count == 1
        frames = sequence.frames()
        next(frames)
        frames.close()
        assert decoded.call_count <= 1 + 1 + decoding.AHEAD


def test_images_are_decoded_while_the_caller_is_busy():
    begun = []

    def load(index):
        begun.append(index)
        return index

    frames = decoding.decode_ahead(load, range(20))
    assert next(frames) == 0
    deadline = time.monotonic() + 10.0
    while len(begun) < decoding.AHEAD and time.monotonic() < deadline:
        time.sleep(0.001)
    assert decoding.AHEAD <= len(begun) <= decoding.AHEAD + 1
    assert list(frames) == list(range(1, 20))


def test_a_failure_of_the_decoder_is_a_lost_frame(tmp_path):
    write_images(tmp_path, ["0.png"])
    with (
        mock.patch.object(cv2, "imdecode", side_effect=cv2.error("too many pixels")),
        pytest.raises(InputError, match=r"0.png: the image cannot be decoded"),
    ):
        decoding.read_grey(tmp_path / "0.png")
