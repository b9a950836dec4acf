"""TUM RGB-D sequences.

- `rgb.txt`: time [s] and file of each image, `#` starting a comment.
- `camera.yaml`: the calibration, which the distributed sequences do not bring along (`calibration` describes it).
- `groundtruth.txt`, if the truth is known: `timestamp tx ty tz qx qy qz qw`, world_from_camera.

J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A benchmark for the evaluation of RGB-D SLAM systems",
IROS 2012.
"""

from pathlib import Path

from rbpf.sensors.readers.images.calibration import find_calibration
from rbpf.sensors.readers.images.files import FileImages, first_shape
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.sensors.readers.images.stamped import read_stamped
from rbpf.sensors.readers.images.truth import read_tum_truth

KIND = "a TUM RGB-D sequence (rgb.txt, camera.yaml)"


def recognises(path: Path) -> bool:
    """Whether the path is a folder with a list of images."""
    return (path / "rgb.txt").is_file()


def read(path: Path, calibration: Path | None) -> ImageSequence:
    """Open the sequence.

    Args:
        path: the folder.
        calibration: a camera file in place of the folder's.

    Raises:
        InputError: a file is missing or not as described above.
    """
    rows = read_stamped(path / "rgb.txt", KIND)
    files = rows.files(path)
    camera = find_calibration(path, calibration)
    shape = first_shape(files, rows.path)
    camera.require_shape(shape, str(path))
    return ImageSequence(
        name=path.resolve().name,
        camera=camera.camera,
        stamps_ns=rows.stamps_ns,
        truth=read_tum_truth(path / "groundtruth.txt", rows.stamps_ns),
        baseline_m=None,
        source=FileImages(rows.stamps_ns, shape, files),
    )
