"""Path and map of a run in memory, of any of the systems."""

from rbpf.runs.path_and_map import PathAndMap
from rbpf.runs.run import Run
from rbpf.systems.map_estimate import estimate_map
from rbpf.systems.stereo.run import StereoRun

AnyRun = Run | StereoRun


def of_run(run: AnyRun) -> PathAndMap:
    """The online filtered poses of a run in memory, and its last map, within + between particles."""
    if isinstance(run, Run):
        return PathAndMap.of_run(run)
    return PathAndMap(run.stamps_ns, run.world_from_camera, run.cov, estimate_map(run.filter))
