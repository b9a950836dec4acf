"""EuRoC MAV sequences in the ASL layout; the path is `mav0` or the folder that holds it.

- `cam0/sensor.yaml`: `resolution`, `intrinsics` (fx, fy, cx, cy), `camera_model: pinhole`, `distortion_model:
  radial-tangential` with `distortion_coefficients` (k1, k2, p1, p2[, k3]) or `equidistant` with k1, k2, k3, k4, and
  `T_BS`, body_from_camera;
- `cam0/data.csv`: time [ns] and file in `cam0/data` of each image;
- `cam1`, for stereo: the same of the right camera. Unrectified pairs are rectified by the two `sensor.yaml`;
- `state_groundtruth_estimate0` or `vicon0`, if the truth is known: `data.csv` with time [ns], position of the
  sensor [m] and its quaternion qw, qx, qy, qz, world_from_sensor, and more columns; `sensor.yaml` with `T_BS`,
  body_from_sensor. The truth returned is world_from_camera = world_from_sensor body_from_sensor⁻¹ body_from_camera.

A camera file given replaces that of `cam0`, and the pair's baseline, if it has one; the images are then taken as rectified,
and the truth remains that of the sequence's camera.
M. Burri, J. Nikolic, P. Gohl, T. Schneider, J. Rehder, S. Omari, M. W. Achtelik, R. Siegwart, "The EuRoC micro aerial
vehicle datasets", IJRR 35(10), 2016.
"""

from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.images.calibration import Calibration, coefficients, read_calibration
from rbpf.sensors.readers.images.decoding import FileImages, first_shape
from rbpf.sensors.readers.images.poses import normalised, pose_of_matrix, truth_between
from rbpf.sensors.readers.images.rectification import pair_stamps, rectified
from rbpf.sensors.readers.images.sequence import ImageFormat, ImageSequence, ReadOptions
from rbpf.sensors.readers.text import read_stamped
from rbpf.sensors.readers.yaml_files import YamlValue, read_yaml

_CAMERA = ["T_BS", "resolution", "camera_model", "intrinsics", "distortion_model", "distortion_coefficients"]
_LENSES = {"radial-tangential": "radial-tangential", "radtan": "radial-tangential", "equidistant": "equidistant"}
_TRUTHS = ("state_groundtruth_estimate0", "vicon0")
_TRUTH_COLUMNS = ("p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z")


@final
class Euroc(ImageFormat):
    """EuRoC MAV sequences in the ASL layout."""

    kind = "an EuRoC sequence in the ASL layout (mav0/cam0 with sensor.yaml and data.csv)"
    stereo_kind = "an EuRoC sequence in the ASL layout (mav0 with cam0 and cam1, each with sensor.yaml and data.csv)"

    def recognises(self, path: Path) -> bool:
        return (path / "mav0").is_dir() or (path / "cam0").is_dir()

    def read(self, path: Path, options: ReadOptions) -> ImageSequence:
        mav = path / "mav0" if (path / "mav0").is_dir() else path
        names, hint = (("cam0", "cam1"), self.stereo_kind) if options.stereo else (("cam0",), self.kind)
        folders = [mav / name for name in names]
        cameras = [_read_camera(folder / "sensor.yaml", hint) for folder in folders]
        (left, body_from_left), (right, body_from_right) = cameras[0], cameras[-1]
        left_from_right = SE3.between(body_from_left, body_from_right)
        sizes = [f"{one.camera.width}x{one.camera.height}" for one in (left, right)]
        if sizes[0] != sizes[1]:
            both = f"cam0 has {sizes[0]} and cam1 {sizes[1]} px, expected one size"
            raise InputError(f"{mav}: {both}; scale the images of one of the two.")
        if options.stereo and not SE3.translation(left_from_right).any():
            problem = "T_BS puts cam1 where cam0 is, a baseline of zero; give the two cameras' own"
            raise InputError(f"{folders[1] / 'sensor.yaml'}: {problem}.")
        # The images of one camera, or those of both that belong together.
        used = left if options.calibration is None else read_calibration(options.calibration)
        listed = [read_stamped(folder / "data.csv", hint, nanoseconds=True) for folder in folders]
        rows, notes = [np.arange(len(listed[0].stamps_ns))], tuple[str, ...]()
        if options.stereo:
            *rows, notes = pair_stamps(listed[0].stamps_ns, listed[1].stamps_ns, options.tolerance_s, str(mav))
        files = []
        for lines, folder, chosen in zip(listed, folders, rows, strict=True):
            paths = lines.files(folder / "data")
            files.append([paths[row] for row in chosen])
            shape = first_shape(files[-1], lines.path)
            used.require_shape(shape, str(folder))
        stamps_ns, whole = listed[0].stamps_ns[rows[0]], mav.resolve()
        truth = _read_truth(mav, body_from_left, stamps_ns)
        name = whole.parent.name if whole.name == "mav0" else whole.name
        source = FileImages(stamps_ns, shape, *files)
        sequence = ImageSequence(name, used.camera, stamps_ns, truth, None, source, notes)
        if not options.stereo:
            return sequence
        if options.calibration is not None:
            baseline_m = used.baseline_m or float(np.linalg.norm(SE3.translation(left_from_right)))
            return replace(sequence, baseline_m=baseline_m)
        note = f"{mav}: the two cameras are not rectified; their images are, by cam0 and cam1's sensor.yaml."
        return rectified(sequence, right.camera, left_from_right, str(folders[1] / "sensor.yaml"), note)


def _read_camera(path: Path, hint: str) -> tuple[Calibration, Array]:
    """A camera and its mounting pose body_from_camera (7,) from a `sensor.yaml`; `hint` describes the expected file."""
    entries = read_yaml(path, hint).entries(_CAMERA)
    entries["camera_model"].choice(["pinhole"])
    model = _LENSES[entries["distortion_model"].choice(list(_LENSES))]
    width, height = (item.size() for item in entries["resolution"].items(2))
    fx, fy, cx, cy = entries["intrinsics"].items(4)
    lens = coefficients(entries["distortion_coefficients"], model)
    camera = Pinhole(width, height, fx.positive(), fy.positive(), cx.number(), cy.number(), lens, model)
    return Calibration(str(path), camera), _mount(entries["T_BS"])


def _read_truth(mav: Path, body_from_camera: Array, images_ns: np.ndarray) -> Truth | None:
    """Ground truth of a camera with images at `images_ns`, or None."""
    for kind in _TRUTHS:
        file, mount = mav / kind / "data.csv", mav / kind / "sensor.yaml"
        if not file.exists():
            continue
        rows = read_stamped(file, "poses", nanoseconds=True)
        table = rows.table(_TRUTH_COLUMNS)
        xyzw = np.roll(table.block("q_w", "q_z"), -1, axis=1)
        world_from_sensor = normalised(np.hstack([xyzw, table.block("p_x", "p_z")]), table.error)
        if kind == _TRUTHS[0] and not mount.exists():
            # The estimated state is that of the body by definition; a marker's mounting pose has to be given.
            sensor_from_body = SE3.identity()
        else:
            hint = "a sensor.yaml with T_BS, the pose of the sensor on the body"
            sensor_from_body = SE3.inverse(_mount(read_yaml(mount, hint).entries(["T_BS"])["T_BS"]))
        poses = SE3.compose(world_from_sensor, SE3.compose(sensor_from_body, body_from_camera))
        return truth_between(file, rows.stamps_ns, poses, images_ns)
    return None


def _mount(value: YamlValue) -> Array:
    """body_from_sensor (7,) of a T_BS."""
    numbers = [item.number() for item in value.entries(["data"])["data"].items(16)]
    return pose_of_matrix(np.reshape(numbers, (4, 4)), lambda problem: value.error(f"T_BS: {problem}"))
