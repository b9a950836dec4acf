"""Stereo feature tracks in the format of GTSAM's stereo examples: observations of landmarks, and an initial path.

The folder holds one file of each kind:

- `VO_calibration*.txt`: fx, fy, skew, cx, cy, baseline (pixels; metres) of a rectified pair; the skew is zero.
- `VO_camera_poses*.txt`: a frame, then the 16 numbers of its matrix world_from_camera, row by row; frames count from 0.
- `VO_stereo_factors*.txt`: a frame, a landmark, u_left, u_right, v (pixels), and X, Y, Z of the landmark in that
  camera's frame. Only the pixels are read, as the point follows from them.

Times are not given: a frame's stamp is its number.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.readers.text import line_error, parse_table, read_columns, read_text

CALIBRATION = ("fx", "fy", "skew", "cx", "cy", "baseline")
ENTRIES = tuple(f"m{row}{column}" for row in range(1, 5) for column in range(1, 5))
POSES = ("frame", *ENTRIES)
FACTORS = ("frame", "landmark", "u_left", "u_right", "v", "x", "y", "z")

KITTI_00 = (1241, 376)
"""Width and height of the images of KITTI's sequence 00, which are not in the files."""
ROTATION = 1e-3
"""Tolerance of a rotation matrix's orthonormality: files have six digits."""


@dataclass(frozen=True)
class StereoTracks:
    """A recording and its initial path.

    Attributes:
        log: the frames and the camera.
        world_from_camera: (T, 7) initial path, not ground truth.
    """

    log: FeatureLog
    world_from_camera: Array


def read_stereo_tracks(folder: str | Path, std_px: float = 1.0, size: tuple[int, int] = KITTI_00) -> StereoTracks:
    """Reads a folder of tracks.

    Args:
        folder: of the three files.
        std_px: standard deviation of each coordinate of an observation.
        size: width and height of the images, px.

    Raises:
        InputError: a file is missing or there are several of its kind, or a line is not as expected.
    """
    folder = Path(folder)
    if not (np.isfinite(std_px) and std_px > 0.0):
        raise InputError(f"the standard deviation of an observation must be positive, got {std_px} px")
    # The camera.
    file = _only(folder, "VO_calibration*.txt")
    table = parse_table(file, CALIBRATION, enumerate(read_text(file).splitlines(), 1))
    if len(table.lines) != 1:
        raise table.error(1, "expected one line of calibration, found another")
    fx, fy, skew, cx, cy, baseline = table.values[0].tolist()
    if skew != 0.0:
        raise table.error(0, f"expected no skew of a rectified pair, found {skew}")
    try:
        camera = RectifiedStereo(Pinhole(*size, fx, fy, cx, cy), baseline)
    except InputError as error:
        raise line_error(file, table.lines[0], str(error)) from error

    # The path.
    table = read_columns(_only(folder, "VO_camera_poses*.txt"), POSES)
    numbers = table.integers("frame")
    table.require(numbers == np.arange(len(numbers)), "frame", "the line's number counted from 0")
    matrices = table.block(ENTRIES[0], ENTRIES[-1]).reshape(-1, 4, 4)
    turn = matrices[:, :3, :3]
    off = np.abs(turn @ turn.mT - np.eye(3)).max(axis=(1, 2))
    last = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
    wrong = (off > ROTATION) | (np.linalg.det(turn) < 0.0) | (last > 0.0)
    if wrong.any():
        raise table.error(int(np.argmax(wrong)), "expected a rotation, a translation and the row 0 0 0 1")

    # The observations.
    table, count = read_columns(_only(folder, "VO_stereo_factors*.txt"), FACTORS), len(numbers)
    steps, names = table.integers("frame"), table.integers("landmark")
    table.require((steps >= 0) & (steps < count), "frame", f"that of a pose, 0 to {count - 1}")
    z = np.stack([table["u_left"], table["v"], table["u_right"]], axis=1)
    table.require(z[:, 0] > z[:, 2], "u_left", "greater than u_right")
    table.require_distinct(steps, names, "frame")
    frames = []
    for step in range(count):
        rows = np.flatnonzero(steps == step)
        cov = np.tile(std_px**2 * np.eye(3), (len(rows), 1, 1))
        frames.append(FeatureFrame(step, names[rows], z[rows], cov))
    return StereoTracks(FeatureLog(folder.resolve().name, camera, frames), SE3.from_matrix(matrices))


def _only(folder: Path, pattern: str) -> Path:
    """The one file of a kind."""
    found = sorted(folder.glob(pattern)) if folder.is_dir() else []
    if len(found) != 1:
        there = ", ".join(path.name for path in found) or "none"
        raise InputError(f"{folder}: expected one file {pattern} of stereo tracks, found {there}.")
    return found[0]
