"""A recording of a stereo run for the Rerun viewer (https://rerun.io), written without a screen.

world/camera             the left camera's pose
world/camera/image       its images, with features: landmarks, candidates, new ones, and the rest
world/seen               where the pair's landmarks were seen
world/path, world/odometry   the filter's path, and that of the odometry alone
world/map                the final map with 3σ ellipsoids
plots/…                  features, matches and landmarks over the pairs
"""

from pathlib import Path
from typing import Any

from rbpf.lie import SE3
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.report.rerun import ellipsoids, log_image, log_lens, log_pose, log_time, recording
from rbpf.validation.report.stereo_frames import COLOURS, NAMES
from rbpf.validation.report.video import FOUND


def write_stereo_rerun(run: StereoRun, sequence: ImageSequence, mapped: MapEstimate, path: Path) -> None:
    """Writes the recording; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        sequence: its images.
        mapped: its map.
        path: the file, .rrd.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    with recording(path, run.name) as (rr, stream):
        _log_static(rr, stream, run, mapped)
        for t, frame in zip(range(run.stamps_ns.size), sequence.frames(), strict=False):
            log_time(stream, t, int(run.stamps_ns[t] - run.stamps_ns[0]))
            log_image(rr, stream, frame)
            _log_pair(rr, stream, run, t)


def _log_static(rr: Any, stream: Any, run: StereoRun, mapped: MapEstimate) -> None:
    log_lens(rr, stream, run.rig.camera)
    for name, poses in (("path", run.world_from_camera), ("odometry", run.odometry)):
        stream.log(f"world/{name}", rr.LineStrips3D([SE3.translation(poses)]), static=True)
    stream.log("world/map", ellipsoids(rr, mapped), static=True)


def _log_pair(rr: Any, stream: Any, run: StereoRun, t: int) -> None:
    at, seen = run.world_from_camera[t], run.pair_seen(t)
    log_pose(rr, stream, "camera", at)
    for kind, name in NAMES.items():
        pixels = rr.Points2D(seen.of(kind)[:, :2] + 0.5, colors=[COLOURS[kind]])
        stream.log(f"world/camera/image/{name.replace(' ', '_')}", pixels)
    places = SE3.transform(at, run.rig.triangulate(seen.of(FeatureKind.LANDMARK)))
    stream.log("world/seen", rr.Points3D(places, colors=[FOUND], radii=0.005))
    for name in ("features", "agreeing", "observed"):
        stream.log(f"plots/{name}", rr.Scalars(float(getattr(run, name)[t])))
