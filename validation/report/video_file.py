"""A video file of pictures that are drawn and encoded one after the other."""

from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import numpy as np

from rbpf.runs.files import whole

SHORTEST_S, LONGEST_S = 1.0 / 120.0, 1.0
"""Bounds of the time per image, for sequences whose stamps say little: photos, equal stamps."""

QUALITY = "23"
"""Constant rate factor of H.264: 18 is nearly without loss, 28 poor."""

ENCODING = "-preset", "veryfast", "-fflags", "+bitexact", "-flags:v", "+bitexact"


def write_video(
    pictures: Iterable[np.ndarray],
    size: tuple[int, int],
    stamps_ns: np.ndarray,
    path: Path,
    on_frame: Callable[[int, int], None] | None = None,
) -> None:
    """Writes an MP4; it appears under its name when it is complete.

    Args:
        pictures: (H, W, 3) uint8.
        size: their width and height, even numbers.
        stamps_ns: (T,) of the pictures; it runs as fast as these.
        path: the file.
        on_frame: called with the pictures written and their number.

    Raises:
        InputError: the place cannot be written to, or the disk is full.
    """
    import imageio_ffmpeg

    with whole(path) as partial:
        encoder = imageio_ffmpeg.write_frames(
            str(partial),
            size,
            fps=frame_rate(stamps_ns),
            codec="libx264",
            quality=None,
            macro_block_size=2,
            pix_fmt_out="yuv420p",
            output_params=["-crf", QUALITY, *ENCODING],
            ffmpeg_log_level="error",
        )
        with closing(encoder):
            encoder.send(None)
            for t, picture in enumerate(pictures):
                encoder.send(np.ascontiguousarray(picture))
                if on_frame is not None:
                    on_frame(t + 1, stamps_ns.size)
        if not is_complete(partial):
            # The encoder says nothing through the pipe of what went wrong behind it.
            raise OSError("the encoder could not finish, the disk may be full")


def is_complete(path: Path) -> bool:
    """Whether an MP4 holds all that it announces: its boxes fill the file, and the frames' index is among them."""
    size, place, kinds = path.stat().st_size, 0, list[bytes]()
    with path.open("rb") as file:
        while place + 8 <= size:
            file.seek(place)
            length, kind = int.from_bytes(file.read(4), "big"), file.read(4)
            if length == 1:
                length = int.from_bytes(file.read(8), "big")
            if length < 8:
                return False
            kinds.append(kind)
            place += length
    return place == size and b"moov" in kinds


def frame_rate(stamps_ns: np.ndarray) -> float:
    """Images per second of a video that runs as fast as the recording."""
    gaps = np.diff(stamps_ns) * 1e-9
    gaps = gaps[gaps > 0.0]
    typical = float(np.median(gaps)) if gaps.size else LONGEST_S
    return round(1.0 / min(max(typical, SHORTEST_S), LONGEST_S), 3)
