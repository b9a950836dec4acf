"""`camera.yaml`: the camera that took the images.

model: pinhole                          # optional; the only one
fx: 525.0                               # px
fy: 525.0
cx: 320.0                               # px, the centre of the top-left pixel is (0, 0)
cy: 240.0
width: 640                              # px, must be the size of the images
height: 480
distortion: [0.0, 0.0, 0.0, 0.0, 0.0]   # optional; OpenCV's k1, k2, p1, p2, k3; k3 may be left out
rate_hz: 30.0                           # optional; images per second, where the recording has no times
    baseline_m: 0.12                        # optional; of a rectified pair, where the recording has two cameras
"""

from dataclasses import dataclass
from pathlib import Path

from rbpf.errors import InputError
from rbpf.sensors.pinhole import Pinhole
from rbpf.sensors.readers.images.mapping import Value, read_yaml
from rbpf.sensors.readers.text import quoted

NAME = "camera.yaml"
KIND = (
    f"a {NAME} with the keys fx, fy, cx, cy, width, height and, if the images are distorted, distortion "
    "(`rbpf calibrate` makes one)"
)

_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height")
_OPTIONAL = ("model", "distortion", "rate_hz", "baseline_m")


@dataclass(frozen=True)
class Calibration:
    """A camera and where it stands.

    Attributes:
        where: the file, for messages.
        camera: the camera.
        rate_hz: images per second, None where the file does not say.
        baseline_m: of a rectified pair, None where the file does not say.
    """

    where: str
    camera: Pinhole
    rate_hz: float | None = None
    baseline_m: float | None = None

    def require_shape(self, shape: tuple[int, int], what: str) -> None:
        """Refuse images of another size.

        Args:
            shape: height and width of the images.
            what: the images, for the message.

        Raises:
            InputError: the sizes differ.
        """
        camera = self.camera
        if shape != (camera.height, camera.width):
            found = f"the images of {what} have {shape[1]}x{shape[0]} px"
            action = "give the calibration of these images, or scale fx, fy, cx and cy with them"
            raise InputError(
                f"{self.where}: width and height are {camera.width}x{camera.height}, {found}; {action}."
            )


def find_calibration(folder: Path, given: Path | None) -> Calibration:
    """The given calibration, or the one in the folder.

    Raises:
        InputError: there is none, or it is not as described above.
    """
    return read_calibration(folder / NAME if given is None else given)


def read_calibration(path: Path) -> Calibration:
    """Read a `camera.yaml`.

    Raises:
        InputError: the file is missing or not as described above.
    """
    whole = read_yaml(path, KIND)
    entries = whole.entries()
    whole.require_keys(entries, _REQUIRED)
    for name, value in entries.items():
        if name not in _REQUIRED + _OPTIONAL:
            known = ", ".join(_REQUIRED + _OPTIONAL)
            raise value.error(f"{quoted(name)} is no key of a camera, expected some of {known}")
    if "model" in entries:
        entries["model"].choice(["pinhole"])
    return Calibration(
        where=str(path),
        camera=_camera(entries),
        rate_hz=entries["rate_hz"].positive() if "rate_hz" in entries else None,
        baseline_m=entries["baseline_m"].positive() if "baseline_m" in entries else None,
    )


def coefficients(value: Value) -> tuple[float, float, float, float, float]:
    """Distortion k1, k2, p1, p2, k3 of a list of four or five.

    Raises:
        InputError: it is no such list.
    """
    k1, k2, p1, p2, *k3 = [item.number() for item in value.items(4, 5)]
    return k1, k2, p1, p2, k3[0] if k3 else 0.0


def _camera(entries: dict[str, Value]) -> Pinhole:
    distortion = entries.get("distortion")
    return Pinhole(
        width=entries["width"].size(),
        height=entries["height"].size(),
        fx=entries["fx"].positive(),
        fy=entries["fy"].positive(),
        cx=entries["cx"].number(),
        cy=entries["cy"].number(),
        distortion=coefficients(distortion) if distortion else (0.0, 0.0, 0.0, 0.0, 0.0),
    )
