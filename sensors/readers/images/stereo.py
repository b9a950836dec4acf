"""Recordings of two cameras side by side: EuRoC ASL (`cam0`, `cam1`), KITTI (`image_0`, `image_1`), ROS bags.

Images of EuRoC and of bags are paired by their times; what has no partner is left out, which `StereoSequence.notes`
says. Images that are not rectified become so by the two `sensor.yaml` or CameraInfo; the truth is then that of the
rectified left camera. KITTI's images are rectified and have numbers: one that is missing on either side is a pair with
a problem.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import CameraTruth
from rbpf.sensors.readers.images import bag, bag_pair, euroc, euroc_pair, kitti
from rbpf.sensors.readers.images.pairing import TOLERANCE_S
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence
from rbpf.sensors.readers.images.topics import UNNAMED, Topics

_log = logging.getLogger(__name__)


@final
@dataclass(frozen=True)
class StereoSequence:
    """A recording of a rectified stereo pair; no image but the first is decoded before `frames` is called.

    Attributes:
        pair: the images, the left camera, times and truth.
        rig: the two cameras as the images come out of `frames`.
        notes: one sentence for each thing that was left out or changed.
    """

    pair: ImageSequence
    rig: RectifiedStereo
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.pair)

    @property
    def name(self) -> str:
        """Short name of the recording."""
        return self.pair.name

    @property
    def stamps_ns(self) -> np.ndarray:
        """(T,) int64 times of the pairs, those of the left images."""
        return self.pair.stamps_ns

    @property
    def truth(self) -> CameraTruth | None:
        """world_from_camera of the rectified left camera; None where unknown."""
        return self.pair.truth

    def frames(self, start: int = 0) -> Iterator[ImageFrame]:
        """Pairs in order of time, both images of one size.

        Where one of the two cannot be read, that image is None and `problem` says why: the pair is to be passed over.

        Raises:
            InputError: there is no pair of that number.
        """
        return self.pair.frames(start)


def open_stereo(
    path: str | Path,
    calibration: str | Path | None = None,
    tolerance_s: float = TOLERANCE_S,
    topics: Topics = UNNAMED,
) -> StereoSequence:
    """Open a stereo sequence.

    Args:
        path: its folder, or a ROS bag.
        calibration: a `camera.yaml` of the rectified left camera, in place of the sequence's own calibration; with
            `baseline_m`, in place of its baseline, too.
        tolerance_s: images of two cameras whose times differ by no more belong together; KITTI's have numbers.
        topics: of a ROS bag, where they have to be named.

    Raises:
        InputError: nothing is there, or it is no stereo sequence; a file is missing or malformed; no two images
            belong together; the two cameras' images differ in size; the baseline is zero, or the right camera is not
            to the right of the left one.
    """
    path = Path(path)
    given = None if calibration is None else Path(calibration)
    if bag.recognises(path):
        pair, rig, notes = bag_pair.read(path, given, tolerance_s, topics)
    elif euroc.recognises(path):
        topics.require_none(path)
        pair, rig, notes = euroc_pair.read(path, given, tolerance_s)
    elif kitti.recognises(path):
        topics.require_none(path)
        pair, rig, notes = kitti.read_pair(path, given)
    else:
        found = (
            f"the {'folder' if path.is_dir() else 'file'} is neither" if path.exists() else "no such folder"
        )
        kinds = f"{euroc_pair.KIND}; or {kitti.PAIR_KIND}; or {bag_pair.PAIR_KIND}"
        raise InputError(f"{path}: {found}, expected {kinds}.")
    for note in notes:
        _log.warning("%s", note)
    return StereoSequence(pair, rig, notes)
