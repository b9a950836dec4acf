"""Path and map of a run in memory, of any of the systems."""

from rbpf.runs.path_and_map import PathAndMap
from rbpf.runs.run import Run
from rbpf.systems.map_estimate import MapEstimate, estimate_map
from rbpf.systems.mono.run import MonoRun
from rbpf.systems.mono.video import VideoRun
from rbpf.systems.stereo.run import StereoRun
from rbpf.validation.camera_map import summarise_points

AnyRun = Run | MonoRun | VideoRun | StereoRun


def of_run(run: AnyRun) -> PathAndMap:
    """The online filtered poses of a run in memory, and its last map, within + between particles."""
    if isinstance(run, Run):
        return PathAndMap.of_run(run)
    if isinstance(run, MonoRun):
        return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, summarise_points(run.filter))
    if isinstance(run, StereoRun):
        return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, estimate_map(run.filter))
    mapped = run.slam.map()
    full = ~mapped.is_ray()
    points = MapEstimate(mapped.ids[full], mapped.mean[full], mapped.cov[full])
    return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, points)
