"""The second camera of an ASL sequence.

It is read where the pair is rectified: both cameras have one size and one set of intrinsics, no distortion, equal
axes, and the second lies to the right of the first along the rows. Other pairs are read as one camera.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.euroc_camera import AslCamera, read_camera
from rbpf.sensors.readers.images.stamped import StampedLines, read_stamped

ALIKE_PX = 1e-2
"""How far intrinsics of a rectified pair may differ: rounding, and no more than an image can show."""

TURNED, SHIFTED = 1e-4, 1e-2
"""How far the axes may be turned [rad], and how far off the rows the baseline may point, relative to its length."""

_log = logging.getLogger(__name__)


def read_right(
    folder: Path, left: AslCamera, used: Pinhole, rows: StampedLines
) -> tuple[Sequence[Path | None] | None, float | None]:
    """Files of the second camera, matched with the first one's by equal stamps, and the baseline.

    Args:
        folder: `cam1`; it may be missing.
        left: the first camera as the sequence describes it.
        used: the first camera as it is used.
        rows: the first camera's images.

    Returns:
        T files, None where the second camera has no image of this time, and the baseline [m]; or two None where
        there is no second camera or the pair is not rectified.

    Raises:
        InputError: a file of the second camera is not as it should be.
    """
    if not folder.is_dir():
        return None, None
    right = read_camera(folder / "sensor.yaml", "the second camera")
    baseline_m = rectified_baseline(left, right)
    if baseline_m is None or not used.lens.is_identity:
        _log.info("%s: left out, as the two cameras are not rectified", folder)
        return None, None
    listed = read_stamped(folder / "data.csv", "the second camera's images", ",", nanoseconds=True)
    by_stamp = dict(zip(listed.stamps_ns.tolist(), listed.files(folder / "data"), strict=True))
    return [by_stamp.get(stamp) for stamp in rows.stamps_ns.tolist()], baseline_m


def rectified_baseline(left: AslCamera, right: AslCamera) -> float | None:
    """Distance [m] of the cameras of a rectified pair, None where they are not one."""
    first, second = left.calibration.camera, right.calibration.camera
    if (first.width, first.height) != (second.width, second.height):
        return None
    if not (first.lens.is_identity and second.lens.is_identity):
        return None
    if np.abs(first.params - second.params).max() > ALIKE_PX:
        return None
    left_from_right = SE3.between(left.body_from_camera, right.body_from_camera)
    along, *across = SE3.translation(left_from_right)
    turned = np.linalg.norm(SE3.log(left_from_right)[:3])
    if turned > TURNED or along <= 0.0 or np.linalg.norm(across) > SHIFTED * along:
        return None
    return float(along)
