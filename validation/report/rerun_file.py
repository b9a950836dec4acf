"""What recordings of runs for the Rerun viewer (https://rerun.io) share."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import prepare_folder, whole
from rbpf.runs.plots import SIGMAS
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import ImageFrame
from rbpf.systems.map_estimate import MapEstimate

QUALITY = 75
"""Of the JPEG images in the recording, in per cent."""

AXIS_M = 0.1
"""Length of the camera's drawn image plane from its centre."""


def require_rerun() -> Any:
    """The package.

    Raises:
        InputError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            "--rerun needs the package rerun-sdk, which is not installed: pip install 'rbpf[viewing]', or leave it out"
        ) from error
    return rerun


@contextmanager
def recording(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """The package and a stream into a file, which appears under its name when it is complete.

    Args:
        path: the file, .rrd.
        name: of the recording.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    rr = require_rerun()
    prepare_folder(path.parent)
    with whole(path) as partial, rr.RecordingStream("rbpf", recording_id=name) as stream:
        stream.save(str(partial))
        yield rr, stream
        stream.flush()


def log_lens(rr: Any, stream: Any, camera: Pinhole) -> None:
    """The camera's; Rerun's pixels start at a corner, not at a centre."""
    lens = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=AXIS_M,
    )
    stream.log("world/camera", lens, static=True)


def log_time(stream: Any, t: int, after_ns: int) -> None:
    """Number of a frame and time since the first one [ns]; what is logged next belongs to it."""
    stream.set_time("frame", sequence=t)
    stream.set_time("time", duration=1e-9 * float(after_ns))


def log_image(rr: Any, stream: Any, frame: ImageFrame) -> None:
    """A frame's image, if it has one."""
    if frame.image is not None:
        stream.log("world/camera/image", rr.Image(frame.image).compress(jpeg_quality=QUALITY))


def log_pose(rr: Any, stream: Any, name: str, pose: np.ndarray) -> None:
    """Where a camera or a robot is in the world, (7,)."""
    turned = rr.Quaternion(xyzw=pose[:4])
    stream.log(f"world/{name}", rr.Transform3D(translation=SE3.translation(pose), quaternion=turned))


def ellipsoids(rr: Any, landmarks: MapEstimate) -> Any:
    """A map's 3σ ellipsoids, with the landmarks' names."""
    values, vectors = np.linalg.eigh(landmarks.cov)
    turned = vectors * np.where(np.linalg.det(vectors) < 0.0, -1.0, 1.0)[:, None, None]
    poses = np.concatenate([turned, landmarks.mean[..., None]], axis=-1)
    return rr.Ellipsoids3D(
        centers=landmarks.mean,
        half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=SE3.from_matrix(poses)[:, :4],
        labels=[str(name) for name in landmarks.ids],
        show_labels=False,
    )
