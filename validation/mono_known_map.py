"""The map of a run over images, kept so that later runs can find their camera in it."""

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.calibration.boards import spread_rows
from rbpf.systems.mono.known_map import KnownMap
from rbpf.systems.mono.system import world_of
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.metrics.mono_scores import usual_alignment
from rbpf.validation.mono_map import MonoMap

MOST_VIEWS = 16
"""Poses that are kept, to look from at a camera of which nothing is known."""


def known_map(run: VideoRun, mapped: MonoMap) -> KnownMap:
    """The points of a run's map that it still holds and whose depth is known, with what they look like.

    Args:
        run: that has finished.
        mapped: its map.
    """
    table = run.sensor.table
    kept = np.flatnonzero(~mapped.is_ray & table.alive[mapped.landmarks.ids])
    rows, positions = mapped.landmarks.ids[kept], mapped.landmarks.mean[kept]
    first = table.first_pose[rows]
    world = world_of(run.filter)
    if world is not None:
        first = SE3.compose(SE3.inverse(world.mean[run.filter.belief().mode]), first)
    return KnownMap(
        camera=run.sequence.camera,
        alignment=usual_alignment(run),
        names=rows,
        positions=positions,
        cov=mapped.landmarks.cov[kept],
        windows=table.source[rows],
        first_px=table.first_px[rows],
        first_pose=first,
        views=_views(run, positions),
    )


def _views(run: VideoRun, positions: np.ndarray) -> np.ndarray:
    """Poses of frames that were not lost, far from each other: a turn by a radian is as far as the scene's depth."""
    poses = run.world_from_camera[~run.lost.astype(bool)]
    depth = (
        float(np.linalg.norm(positions - poses[:, 4:].mean(axis=0), axis=1).mean()) if len(positions) else 1.0
    )
    ahead = SE3.rotation(poses) @ np.array([0.0, 0.0, 1.0])
    return np.asarray(poses[spread_rows(np.concatenate([poses[:, 4:] / depth, ahead], axis=1), MOST_VIEWS)])
