"""A recording of a run for the Rerun viewer (https://rerun.io), written without a screen.

world/camera            the camera's pose
world/camera/image      the frames, with search ellipses, found and missed features and epipolar lines
world/seen              points that were found in the frame
world/path, world/map   the whole path, and the final map: points with 3σ ellipsoids, rays as lines
plots/found, plots/lost over the frames
"""

from pathlib import Path
from typing import Any

from rbpf.lie import SE3
from rbpf.runs.plots import outline
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.video import SearchRecord, VideoRun
from rbpf.validation.report.annotated import FOUND, MISSED, STARTED
from rbpf.validation.report.mono_frames import RAY
from rbpf.validation.report.rerun_file import ellipsoids, log_image, log_lens, log_pose, log_time, recording

NEAREST = 0.02
"""Homogeneous weight below which a point that was seen counts as at infinity and is left out, 1/m."""


def write_rerun(run: VideoRun, mapped: MapEstimate, path: Path) -> None:
    """Writes the recording; it appears under its name when it is complete.

    Args:
        run: what was filtered.
        mapped: its map.
        path: the file, .rrd.

    Raises:
        InputError: Rerun is not installed, or the file cannot be written.
    """
    with recording(path, run.sequence.name) as (rr, stream):
        _log_static(rr, stream, run, mapped)
        seen = zip(run.sequence.frames(), run.searches, strict=False)
        for t, (frame, sighting) in enumerate(seen):
            log_time(stream, t, int(run.stamps_ns[t] - run.stamps_ns[0]))
            log_image(rr, stream, frame)
            _log_search(rr, stream, sighting)
            _log_world(rr, stream, run, sighting, t)


def _log_static(rr: Any, stream: Any, run: VideoRun, mapped: MapEstimate) -> None:
    """What does not change: the camera's lens, the known points and the final map."""
    full = ~mapped.is_ray()
    log_lens(rr, stream, run.sequence.camera)
    stream.log("world/path", rr.LineStrips3D([SE3.translation(run.world_from_camera)]), static=True)
    points = MapEstimate(mapped.ids[full], mapped.mean[full], mapped.cov[full])
    stream.log("world/map/points", ellipsoids(rr, points), static=True)
    assert mapped.ray_ends is not None
    ends = mapped.ray_ends[mapped.is_ray()]
    stream.log("world/map/rays", rr.LineStrips3D(ends, colors=[RAY]), static=True)
    if run.known is not None:
        stream.log(
            "world/known_points", rr.Points3D(run.known.positions, colors=[FOUND], radii=0.01), static=True
        )


def _log_search(rr: Any, stream: Any, sighting: SearchRecord) -> None:
    """Features in the image; Rerun's pixels start at a corner, not at a centre."""
    found = sighting.found
    ellipses = outline(sighting.mean, sighting.cov) + 0.5
    for name, chosen, colour in (("found", found, FOUND), ("missed", ~found, MISSED)):
        stream.log(f"world/camera/image/{name}/ellipses", rr.LineStrips2D(ellipses[chosen], colors=[colour]))
    stream.log("world/camera/image/found/places", rr.Points2D(sighting.px[found] + 0.5, colors=[FOUND]))
    stream.log("world/camera/image/new", rr.Points2D(sighting.started_px + 0.5, colors=[STARTED]))
    lines = sighting.line[sighting.is_ray] + 0.5
    stream.log("world/camera/image/epipolar_lines", rr.LineStrips2D(lines, colors=[RAY]))


def _log_world(rr: Any, stream: Any, run: VideoRun, sighting: SearchRecord, t: int) -> None:
    """Where the camera is, and what it sees there."""
    log_pose(rr, stream, "camera", run.world_from_camera[t])
    near = sighting.found & (sighting.position[:, 3] >= NEAREST)
    seen = sighting.position[near, :3] / sighting.position[near, 3:]
    stream.log("world/seen", rr.Points3D(seen, colors=[FOUND], radii=0.005))
    stream.log("plots/found", rr.Scalars(float(run.found[t])))
    stream.log("plots/lost", rr.Scalars(float(run.lost[t])))
