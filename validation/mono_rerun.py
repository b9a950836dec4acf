"""A recording of a run for the Rerun viewer (https://rerun.io), written without a screen.

world/camera            the camera's pose
world/camera/image      the frames, with search ellipses, found and missed features and epipolar lines
world/seen              points that were found in the frame
world/path, world/map   the whole path, and the final map: points with 3σ ellipsoids, rays as lines
plots/found, plots/lost over the frames
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.systems.mono.sightings import Sighting
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.figures import SIGMAS, outline
from rbpf.validation.map_summary import MapSummary
from rbpf.validation.mono_frames import FOUND, MISSED, RAY, STARTED
from rbpf.validation.mono_map import MonoMap

QUALITY = 75
"""Of the JPEG images in the recording, in per cent."""

AXIS_M = 0.1
"""Length of the camera's drawn image plane from its centre."""

NEAREST = 0.02
"""Homogeneous weight below which a point that was seen counts as at infinity and is left out, 1/m."""


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


def write_rerun(run: VideoRun, mapped: MonoMap, path: Path) -> None:
    """Writes the recording; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        mapped: its map.
        path: the file, .rrd.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    rr = require_rerun()
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rr.RecordingStream("rbpf", recording_id=run.sequence.name) as stream:
            stream.save(str(partial))
            _log_static(rr, stream, run, mapped)
            for t, (frame, sighting) in enumerate(
                zip(run.sequence.frames(), run.sightings.frames, strict=False)
            ):
                stream.set_time("frame", sequence=t)
                stream.set_time("time", duration=1e-9 * float(run.stamps_ns[t] - run.stamps_ns[0]))
                if frame.image is not None:
                    stream.log("world/camera/image", rr.Image(frame.image).compress(jpeg_quality=QUALITY))
                _log_search(rr, stream, sighting)
                _log_world(rr, stream, run, sighting, t)
            stream.flush()
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def ellipsoids(rr: Any, landmarks: MapSummary) -> Any:
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


def _log_static(rr: Any, stream: Any, run: VideoRun, mapped: MonoMap) -> None:
    """What does not change: the camera's lens, the known points and the final map."""
    camera, full = run.sequence.camera, ~mapped.is_ray
    lens = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=AXIS_M,
    )
    stream.log("world/camera", lens, static=True)
    stream.log("world/path", rr.LineStrips3D([SE3.translation(run.world_from_camera)]), static=True)
    points = MapSummary(mapped.landmarks.ids[full], mapped.landmarks.mean[full], mapped.landmarks.cov[full])
    stream.log("world/map/points", ellipsoids(rr, points), static=True)
    stream.log("world/map/rays", rr.LineStrips3D(mapped.ends[mapped.is_ray], colors=[RAY]), static=True)
    if run.known is not None:
        stream.log(
            "world/known_points", rr.Points3D(run.known.positions, colors=[FOUND], radii=0.01), static=True
        )


def _log_search(rr: Any, stream: Any, sighting: Sighting) -> None:
    """Features in the image; Rerun's pixels start at a corner, not at a centre."""
    found = sighting.found
    ellipses = outline(sighting.mean, sighting.cov) + 0.5
    for name, chosen, colour in (("found", found, FOUND), ("missed", ~found, MISSED)):
        stream.log(f"world/camera/image/{name}/ellipses", rr.LineStrips2D(ellipses[chosen], colors=[colour]))
    stream.log("world/camera/image/found/places", rr.Points2D(sighting.px[found] + 0.5, colors=[FOUND]))
    stream.log("world/camera/image/new", rr.Points2D(sighting.started + 0.5, colors=[STARTED]))
    lines = sighting.line[sighting.is_ray] + 0.5
    stream.log("world/camera/image/epipolar_lines", rr.LineStrips2D(lines, colors=[RAY]))


def _log_world(rr: Any, stream: Any, run: VideoRun, sighting: Sighting, t: int) -> None:
    """Where the camera is, and what it sees there."""
    world_from_camera = run.world_from_camera[t]
    pose = rr.Transform3D(
        translation=SE3.translation(world_from_camera), quaternion=rr.Quaternion(xyzw=world_from_camera[:4])
    )
    stream.log("world/camera", pose)
    near = sighting.found & (sighting.place[:, 3] >= NEAREST)
    seen = sighting.place[near, :3] / sighting.place[near, 3:]
    stream.log("world/seen", rr.Points3D(seen, colors=[FOUND], radii=0.005))
    stream.log("plots/found", rr.Scalars(float(run.found[t])))
    stream.log("plots/lost", rr.Scalars(float(run.lost[t])))
