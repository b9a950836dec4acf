"""Recordings for the Rerun viewer (https://rerun.io), written without a screen: what those of all cameras have."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.pinhole import Pinhole
from rbpf.validation.figures import SIGMAS

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
def recording(name: str, path: Path) -> Iterator[tuple[Any, Any]]:
    """The package, and the stream of a recording; the file appears under its name when it is complete.

    Args:
        name: of the recording.
        path: the file, .rrd.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    rr = require_rerun()
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rr.RecordingStream("rbpf", recording_id=name) as stream:
            stream.save(str(partial))
            yield rr, stream
            stream.flush()
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def set_time(stream: Any, t: int, stamps_ns: np.ndarray) -> None:
    """What follows belongs to frame t."""
    stream.set_time("frame", sequence=t)
    stream.set_time("time", duration=1e-9 * float(stamps_ns[t] - stamps_ns[0]))


def log_image(rr: Any, stream: Any, image: np.ndarray | None) -> None:
    """What the camera sees, if it could be read."""
    if image is not None:
        stream.log("world/camera/image", rr.Image(image).compress(jpeg_quality=QUALITY))


def log_lens(rr: Any, stream: Any, camera: Pinhole) -> None:
    """The camera; Rerun's pixels start at a corner, not at a centre."""
    lens = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=AXIS_M,
    )
    stream.log("world/camera", lens, static=True)


def log_pose(rr: Any, stream: Any, world_from_camera: np.ndarray) -> None:
    """Where the camera (7,) is."""
    at = SE3.translation(world_from_camera)
    stream.log(
        "world/camera", rr.Transform3D(translation=at, quaternion=rr.Quaternion(xyzw=world_from_camera[:4]))
    )


def ellipsoids(rr: Any, mean: np.ndarray, cov: np.ndarray, **how: Any) -> Any:
    """3σ ellipsoids of points (M, 3) with covariances (M, 3, 3)."""
    values, vectors = np.linalg.eigh(cov)
    turned = vectors * np.where(np.linalg.det(vectors) < 0.0, -1.0, 1.0)[:, None, None]
    poses = np.concatenate([turned, mean[..., None]], axis=-1)
    sizes = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    return rr.Ellipsoids3D(centers=mean, half_sizes=sizes, quaternions=SE3.from_matrix(poses)[:, :4], **how)
