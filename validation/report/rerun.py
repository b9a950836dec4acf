"""A recording of a run for the Rerun viewer (https://rerun.io), written without a screen.

world/camera                   the camera's pose; of a robot world/body
world/camera/image             the frames, with what was looked for and seen in them
world/seen                     points that were seen in the frame
world/path, world/odometry     the whole path, and that of the odometry alone
world/map                      the final map: points with 3σ ellipsoids, rays as lines; known points
plots/…                        figures over the frames
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import prepare_folder, whole
from rbpf.runs.plots import SIGMAS, outline
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.validation.report.video import FEATURES, FOUND, MISSED, RAY, STARTED

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


def write_rerun(run: Run, path: Path) -> None:
    """Writes the recording (.rrd) of a run over images, whose source is read once more.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    log, draw = run.log, DRAWN[run.system.name]
    stamps, poses = log.stamps_ns, log.poses
    plotted = {name: log[name] for name in draw.plots}
    with recording(path, run.name) as (rr, stream):
        # Rerun's pixels start at a corner, not at a centre.
        camera = draw.camera(run)
        lens = rr.Pinhole(
            focal_length=[camera.fx, camera.fy],
            principal_point=[camera.cx + 0.5, camera.cy + 0.5],
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=AXIS_M,
        )
        stream.log("world/camera", lens, static=True)
        stream.log("world/path", rr.LineStrips3D([SE3.translation(poses)]), static=True)
        if "odometry" in log:
            stream.log("world/odometry", rr.LineStrips3D([SE3.translation(log["odometry"])]), static=True)
        found = run.system.map()
        stream.log("world/map/points", ellipsoids(rr, found.points()), static=True)
        if found.ray_ends is not None and found.is_ray().any():
            rays = rr.LineStrips3D(found.ray_ends[found.is_ray()], colors=[RAY])
            stream.log("world/map/rays", rays, static=True)
        known = getattr(run.system, "known_points", None)
        if known is not None:
            stream.log("world/known_points", rr.Points3D(known.positions, colors=[FOUND], radii=0.01), static=True)
        for t, frame in zip(range(len(log)), run.source.frames(), strict=False):
            log_time(stream, t, int(stamps[t] - stamps[0]))
            if frame.image is not None:
                stream.log("world/camera/image", rr.Image(frame.image).compress(jpeg_quality=QUALITY))
            log_pose(rr, stream, "camera", poses[t])
            draw.seen(rr, stream, run, log.observed(t), poses[t])
            for name, values in plotted.items():
                stream.log(f"plots/{name}", rr.Scalars(float(values[t])))


@contextmanager
def recording(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """The package and a stream into a file (.rrd); the file appears when it is complete. Errors as of `write_rerun`."""
    rr = require_rerun()
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: Rerun writes to no path that is not UTF-8: choose another name") from error
    prepare_folder(path.parent)
    readable = name.encode(errors="replace").decode()  # bytes of a file's name that are no UTF-8
    with whole(path) as partial, rr.RecordingStream("rbpf", recording_id=readable) as stream:
        stream.save(str(partial))
        yield rr, stream
        stream.flush()


def log_time(stream: Any, t: int, after_ns: int) -> None:
    """Number of a frame and time since the first one [ns]; what is logged next belongs to it."""
    stream.set_time("frame", sequence=t)
    stream.set_time("time", duration=1e-9 * float(after_ns))


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


@dataclass(frozen=True)
class Drawn:
    """What is particular to a system: its camera, what a frame showed, and which figures are plotted."""

    camera: Callable[[Run], Pinhole]
    seen: Callable[[Any, Any, Run, Mapping[str, np.ndarray], np.ndarray], None]
    plots: tuple[str, ...]


def _log_search(rr: Any, stream: Any, run: Run, seen: Mapping[str, np.ndarray], pose: np.ndarray) -> None:
    """Features that were looked for; Rerun's pixels start at a corner, not at a centre."""
    found = np.isfinite(seen["px"]).all(axis=1)
    ellipses = outline(seen["mean"], seen["cov"]) + 0.5
    for name, chosen, colour in (("found", found, FOUND), ("missed", ~found, MISSED)):
        stream.log(f"world/camera/image/{name}/ellipses", rr.LineStrips2D(ellipses[chosen], colors=[colour]))
    stream.log("world/camera/image/found/places", rr.Points2D(seen["px"][found] + 0.5, colors=[FOUND]))
    stream.log("world/camera/image/new", rr.Points2D(seen["started_px"] + 0.5, colors=[STARTED]))
    lines = seen["line"][np.isfinite(seen["line"]).all(axis=(1, 2))] + 0.5
    stream.log("world/camera/image/epipolar_lines", rr.LineStrips2D(lines, colors=[RAY]))
    near = found & (seen["position"][:, 3] >= NEAREST)
    places = seen["position"][near, :3] / seen["position"][near, 3:]
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))


def _log_pair(rr: Any, stream: Any, run: Run, seen: Mapping[str, np.ndarray], pose: np.ndarray) -> None:
    """Features of the left image by what they were to the map, and where the pair itself has its landmarks."""
    for kind, (name, colour) in FEATURES.items():
        pixels = rr.Points2D(seen["z"][seen["kind"] == kind, :2] + 0.5, colors=[colour])
        stream.log(f"world/camera/image/{name}", pixels)
    rig = run.system.rig
    places = SE3.transform(pose, rig.triangulate(seen["z"][seen["kind"] == FeatureKind.LANDMARK]))
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))


DRAWN = {
    "mono": Drawn(lambda run: run.system.camera, _log_search, ("found", "lost")),
    "stereo": Drawn(lambda run: run.system.rig.camera, _log_pair, ("features", "agreeing", "observed")),
}
"""By the system's name."""
