"""A recording of a stereo run for the Rerun viewer (https://rerun.io), written without a screen.

world/camera             the left camera's pose, with its images
world/path, world/odometry   the filter's path, and that of the odometry alone
world/map                the final map with 3σ ellipsoids
plots/…                  features, matches and landmarks over the pairs
"""

import os
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers.images.stereo import StereoSequence
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.map_summary import MapSummary
from rbpf.validation.mono_rerun import AXIS_M, QUALITY, ellipsoids, require_rerun


def write_stereo_rerun(run: StereoRun, sequence: StereoSequence, mapped: MapSummary, path: Path) -> None:
    """Writes the recording; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        sequence: its images.
        mapped: its map.
        path: the file, .rrd.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    rr = require_rerun()
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rr.RecordingStream("rbpf", recording_id=run.name) as stream:
            stream.save(str(partial))
            _log_static(rr, stream, run, mapped)
            for t, frame in zip(range(run.stamps_ns.size), sequence.frames(), strict=False):
                stream.set_time("frame", sequence=t)
                stream.set_time("time", duration=1e-9 * float(run.stamps_ns[t] - run.stamps_ns[0]))
                if frame.image is not None:
                    stream.log("world/camera/image", rr.Image(frame.image).compress(jpeg_quality=QUALITY))
                _log_pair(rr, stream, run, t)
            stream.flush()
        os.replace(partial, path)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _log_static(rr: Any, stream: Any, run: StereoRun, mapped: MapSummary) -> None:
    camera = run.front_end.rig.camera
    lens = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx + 0.5, camera.cy + 0.5],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=AXIS_M,
    )
    stream.log("world/camera", lens, static=True)
    for name, poses in (("path", run.world_from_camera), ("odometry", run.odometry)):
        stream.log(f"world/{name}", rr.LineStrips3D([SE3.translation(poses)]), static=True)
    stream.log("world/map", ellipsoids(rr, mapped), static=True)


def _log_pair(rr: Any, stream: Any, run: StereoRun, t: int) -> None:
    at = run.world_from_camera[t]
    pose = rr.Transform3D(translation=SE3.translation(at), quaternion=rr.Quaternion(xyzw=at[:4]))
    stream.log("world/camera", pose)
    for name in ("features", "agreeing", "observed"):
        stream.log(f"plots/{name}", rr.Scalars(float(getattr(run, name)[t])))
