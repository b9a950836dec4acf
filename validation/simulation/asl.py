"""Writes image sequences as EuRoC ASL folders (M. Burri et al., The EuRoC micro aerial vehicle datasets, 2016).

mav0/cam0, mav0/cam1       data/<stamp>.png or .jpg, data.csv, sensor.yaml; the body is the left camera
mav0/depth0                the left camera's depth, 16 bits, 1/5000 m, 0 where there is none or too much
mav0/state_groundtruth_estimate0/data.csv
camera.yaml                the left camera, and the baseline of a stereo pair
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.calibration import model_of

DEPTH_PER_M = 5000.0
"""Of a depth image, as TUM's RGB-D recordings have it: out to 13 m."""

COMPRESSION = 1
"""Of PNG files, 0 to 9: noise does not become much smaller by trying harder."""

TRUTH_COLUMNS = [
    "#timestamp",
    *[f" p_RS_R_{axis} [m]" for axis in "xyz"],
    *[f" q_RS_{axis} []" for axis in "wxyz"],
    *[f" v_RS_R_{axis} [m s^-1]" for axis in "xyz"],
    *[f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"],
    *[f" b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"],
]


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `folder` when all is done, and vanishes if it is interrupted.

    Raises:
        InputError: there is something at `folder` already.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder} exists already: delete it or choose another folder for the images")
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {partial} for the images: {error.strerror}") from error
    try:
        yield partial
        partial.replace(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def image_path(folder: Path, sensor: str, stamp_ns: int, suffix: str = ".png") -> Path:
    """Where an image of a sensor (cam0, cam1, depth0) belongs."""
    return folder / "mav0" / sensor / "data" / f"{stamp_ns}{suffix}"


def write_image(path: Path, image: np.ndarray, quality: int = 0) -> None:
    """A file of an image (H, W) uint8 or uint16; its folder has to be there.

    Args:
        path: with the suffix .png or .jpg.
        image: grey levels.
        quality: of a JPEG file, 1 to 100.
    """
    import cv2

    how = [cv2.IMWRITE_JPEG_QUALITY, quality]
    if path.suffix == ".png":
        how = [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION]
        if image.dtype == np.uint8:
            # What noise leaves to compress is found by Huffman's code alone, in less time.
            how += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    _, encoded = cv2.imencode(path.suffix, image, how)
    path.write_bytes(encoded.tobytes())


def coded_depth(depth: np.ndarray) -> np.ndarray:
    """A depth image (H, W) uint16 of depths [m]."""
    steps = np.rint(DEPTH_PER_M * depth)
    return np.where(steps <= np.iinfo(np.uint16).max, steps, 0.0).astype(np.uint16)


def write_sensor(
    folder: Path,
    sensor: str,
    camera: Pinhole,
    offset_m: float,
    stamps_ns: np.ndarray,
    comment: str,
    suffix: str = ".png",
) -> None:
    """A sensor's folder with its calibration and its index; the images are written by others.

    Args:
        folder: of the sequence.
        sensor: cam0, cam1 or depth0.
        camera: its calibration.
        offset_m: of the sensor from the body along the body's x axis.
        stamps_ns: (T,) of the images.
        comment: what it is, one line.
        suffix: of the images' files.
    """
    place = folder / "mav0" / sensor
    (place / "data").mkdir(parents=True)
    rows = "".join(f"{stamp},{stamp}{suffix}\n" for stamp in stamps_ns.tolist())
    (place / "data.csv").write_text("#timestamp [ns],filename\n" + rows, encoding="utf-8")
    seconds = 1e-9 * float(stamps_ns[-1] - stamps_ns[0])
    rate = (len(stamps_ns) - 1) / seconds if seconds else 0.0
    matrix = np.eye(4)
    matrix[0, 3] = offset_m
    # EuRoC has four coefficients; a fifth is written only where it says something.
    distortion = camera.distortion if any(camera.distortion[4:]) else camera.distortion[:4]
    lines = [
        "sensor_type: camera",
        f"comment: {comment}",
        "T_BS:",
        "  cols: 4",
        "  rows: 4",
        f"  data: {matrix.ravel().tolist()}",
        f"rate_hz: {rate:.6g}",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: {[float(x) for x in camera.params[:4]]}",
        f"distortion_model: {camera.distortion_model}",
        f"distortion_coefficients: {[float(x) for x in distortion]}",
    ]
    if sensor.startswith("depth"):
        lines.append(f"depth_per_m: {DEPTH_PER_M}")
    (place / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_truth(
    folder: Path, stamps_ns: np.ndarray, world_from_body: np.ndarray, velocities: np.ndarray
) -> None:
    """Ground truth: poses (T, 7) and velocities (T, 3) in the world [m/s]; there is no gyroscope: its biases are 0."""
    place = folder / "mav0" / "state_groundtruth_estimate0"
    place.mkdir(parents=True)
    quat_xyzw = world_from_body[:, :4]
    position = SE3.translation(world_from_body)
    wxyz = np.roll(quat_xyzw, 1, axis=1)
    table = np.concatenate([position, wxyz, velocities, np.zeros((len(stamps_ns), 6))], axis=1)
    rows = [
        ",".join([str(stamp), *(f"{x:.12g}" for x in row)])
        for stamp, row in zip(stamps_ns.tolist(), table, strict=True)
    ]
    (place / "data.csv").write_text("\n".join([",".join(TRUTH_COLUMNS), *rows]) + "\n", encoding="utf-8")


def write_calibration(folder: Path, camera: Pinhole, baseline_m: float | None) -> None:
    """camera.yaml: the (left) camera, and the baseline of a stereo pair."""
    fx, fy, cx, cy = camera.params[:4].tolist()
    lines = [
        f"model: {model_of(camera)}",
        *[f"{name}: {value}" for name, value in {"fx": fx, "fy": fy, "cx": cx, "cy": cy}.items()],
        f"width: {camera.width}",
        f"height: {camera.height}",
        f"distortion: {[float(x) for x in camera.distortion]}  # {', '.join(camera.lens.coefficient_names)} (OpenCV)",
    ]
    if baseline_m is not None:
        lines.append(f"baseline_m: {float(baseline_m)}")
    (folder / "camera.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
