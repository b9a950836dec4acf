"""EuRoC ASL sequences of two cameras: pairs of images, rectified where they are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.readers.images import euroc
from rbpf.sensors.readers.images.calibration import read_calibration
from rbpf.sensors.readers.images.euroc_camera import AslCamera, read_camera
from rbpf.sensors.readers.images.euroc_stereo import rectified_baseline
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.pairing import pair_stamps
from rbpf.sensors.readers.images.rectification import Rectification, RectifiedImages
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.stamped import read_stamped

KIND = "an EuRoC sequence in the ASL layout (mav0 with cam0 and cam1, each with sensor.yaml and data.csv)"

Pair = tuple[ImageSequence, RectifiedStereo, tuple[str, ...]]
"""The sequence, the two cameras, and what has to be said about them."""


def read(path: Path, calibration: Path | None, tolerance_s: float) -> Pair:
    """Open the sequence; arguments and errors as of `open_stereo`."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    folders = mav / "cam0", mav / "cam1"
    left, right = (read_camera(folder / "sensor.yaml", KIND) for folder in folders)
    _require_pair(left, right, mav)
    listed = [read_stamped(folder / "data.csv", KIND, ",", nanoseconds=True) for folder in folders]
    *rows, notes = pair_stamps(listed[0].stamps_ns, listed[1].stamps_ns, tolerance_s, str(mav))
    files = []
    for lines, folder, chosen in zip(listed, folders, rows, strict=True):
        paths = lines.files(folder / "data")
        files.append([paths[row] for row in chosen])
    shape = _shape(files, folders, left)
    stamps_ns = listed[0].stamps_ns[rows[0]]
    source = FileImages(stamps_ns, shape, files[0], files[1])
    sequence = euroc.sequence(mav, left, stamps_ns, source)
    if calibration is not None:
        return _given(sequence, calibration, left, right, notes)
    baseline_m = rectified_baseline(left, right)
    if baseline_m is not None:
        rig = RectifiedStereo(left.calibration.camera, baseline_m)
        return replace(sequence, baseline_m=baseline_m), rig, notes
    return _rectified(mav, sequence, left, right, notes)


def _require_pair(left: AslCamera, right: AslCamera, mav: Path) -> None:
    sizes = [f"{asl.calibration.camera.width}x{asl.calibration.camera.height}" for asl in (left, right)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"{mav}: cam0 has {sizes[0]} and cam1 {sizes[1]} px, expected one size; scale the images of one of the two."
        )
    if not SE3.translation(SE3.between(left.body_from_camera, right.body_from_camera)).any():
        where = mav / "cam1" / "sensor.yaml"
        raise InputError(
            f"{where}: T_BS puts cam1 where cam0 is, a baseline of zero; give the two cameras' own."
        )


def _shape(files: list[list[Path]], folders: tuple[Path, Path], left: AslCamera) -> tuple[int, int]:
    for paths, folder in zip(files, folders, strict=True):
        left.calibration.require_shape(first_shape(paths, folder / "data.csv"), str(folder))
    return left.calibration.camera.height, left.calibration.camera.width


def _given(
    sequence: ImageSequence, calibration: Path, left: AslCamera, right: AslCamera, notes: tuple[str, ...]
) -> Pair:
    used = read_calibration(calibration)
    camera = left.calibration.camera
    used.require_shape((camera.height, camera.width), sequence.name)
    apart = SE3.translation(SE3.between(left.body_from_camera, right.body_from_camera))
    baseline_m = used.baseline_m or float(np.linalg.norm(apart))
    rig = RectifiedStereo(used.camera, baseline_m)
    return replace(sequence, camera=used.camera, baseline_m=baseline_m), rig, notes


def _rectified(
    mav: Path, sequence: ImageSequence, left: AslCamera, right: AslCamera, notes: tuple[str, ...]
) -> Pair:
    left_from_right = SE3.between(left.body_from_camera, right.body_from_camera)
    cameras = left.calibration.camera, right.calibration.camera
    done = Rectification.between(*cameras, left_from_right, str(mav / "cam1" / "sensor.yaml"))
    turned = replace(left, body_from_camera=SE3.compose(left.body_from_camera, done.left_from_rectified))
    rectified = replace(
        euroc.sequence(mav, turned, sequence.stamps_ns, RectifiedImages(sequence.source, done)),
        camera=done.rig.camera,
        baseline_m=done.rig.baseline_m,
    )
    note = f"{mav}: the two cameras are not rectified; their images are, by cam0 and cam1's sensor.yaml."
    return rectified, done.rig, (*notes, note)
