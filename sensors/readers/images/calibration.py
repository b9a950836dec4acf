"""`camera.yaml`: the camera that took the images.

model: pinhole                          # optional; or fisheye: an equidistant lens
fx: 525.0                               # px
fy: 525.0
cx: 320.0                               # px, the centre of the top-left pixel is (0, 0)
cy: 240.0
width: 640                              # px, must be the size of the images
height: 480
distortion: [0.0, 0.0, 0.0, 0.0, 0.0]   # optional; OpenCV's k1, k2, p1, p2, k3; k3 may be left out;
                                        # of a fisheye lens cv2.fisheye's k1, k2, k3, k4
rate_hz: 30.0                           # optional; images per second, if there are no times, or for rates below 0.2
baseline_m: 0.12                        # optional; of a rectified pair
"""

from dataclasses import dataclass
from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.camera import LENSES, Pinhole
from rbpf.sensors.readers.yaml_files import YamlValue, read_yaml

NAME = "camera.yaml"
KIND = (
    f"a {NAME} with the keys fx, fy, cx, cy, width, height and, if the images are distorted, distortion "
    "(`rbpf calibrate` makes one)"
)

#: Values of `model` and the distortion models they select.
MODELS = {"pinhole": "radial-tangential", "fisheye": "equidistant"}
_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height")
_OPTIONAL = ("model", "distortion", "rate_hz", "baseline_m")


@dataclass(frozen=True)
class Calibration:
    """A camera and the file that defines it, for messages.

    `rate_hz`, images per second, and `baseline_m`, of a rectified pair, are None if the file does not have them.
    """

    where: str
    camera: Pinhole
    rate_hz: float | None = None
    baseline_m: float | None = None

    def require_shape(self, shape: tuple[int, int], what: str) -> None:
        """Refuse images of another height and width; `what` names them in the message."""
        camera = self.camera
        if shape != (camera.height, camera.width):
            found = f"the images of {what} have {shape[1]}x{shape[0]} px"
            action = "give the calibration of these images, or scale fx, fy, cx and cy with them"
            raise InputError(f"{self.where}: width and height are {camera.width}x{camera.height}, {found}; {action}.")


def read_calibration(path: Path) -> Calibration:
    """Read a `camera.yaml`. Raises InputError: the file is missing or not as described above."""
    entries = read_yaml(path, KIND).entries(_REQUIRED, _OPTIONAL)
    model = MODELS[entries["model"].choice(list(MODELS)) if "model" in entries else "pinhole"]
    width, height = (entries[name].size() for name in ("width", "height"))
    fx, fy = (entries[name].positive() for name in ("fx", "fy"))
    cx, cy = (entries[name].number() for name in ("cx", "cy"))
    given, none = entries.get("distortion"), (0.0,) * len(LENSES[model].coefficient_names)
    camera = Pinhole(width, height, fx, fy, cx, cy, coefficients(given, model) if given else none, model)
    rate_hz, baseline_m = (entries[name].positive() if name in entries else None for name in ("rate_hz", "baseline_m"))
    return Calibration(str(path), camera, rate_hz, baseline_m)


def camera_text(camera: Pinhole, about: str = "", baseline_m: float | None = None) -> str:
    """The text of `camera.yaml` for a camera, or a rectified pair with its baseline; `about` is its first line."""
    lens = [float(value) for value in camera.distortion]
    entries: dict[str, object] = {
        "model": model_of(camera),
        **dict(zip(_REQUIRED[:4], camera.params[:4].tolist(), strict=True)),
        "width": camera.width,
        "height": camera.height,
        "distortion": f"{lens}  # {', '.join(camera.lens.coefficient_names)} (OpenCV)",
    }
    if baseline_m is not None:
        entries["baseline_m"] = float(baseline_m)
    return (f"# {about}\n" if about else "") + "".join(f"{name}: {value}\n" for name, value in entries.items())


def coefficients(value: YamlValue, model: str = "radial-tangential") -> tuple[float, ...]:
    """Coefficients from a list: k1, k2, p1, p2, k3, the last one optional, or k1, k2, k3, k4 if equidistant."""
    count = len(LENSES[model].coefficient_names)
    numbers = [item.number() for item in value.items(*sorted({4, count}))]
    return (*numbers, *[0.0] * (count - len(numbers)))


def model_of(camera: Pinhole) -> str:
    """The value of `model` in a camera's file."""
    return next(name for name, distortion in MODELS.items() if distortion == camera.distortion_model)
