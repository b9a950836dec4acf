"""What a run over images measured, as a log of features: for batch adjustment, for files, to filter it again."""

from typing import NamedTuple

import numpy as np

from rbpf.sensors.features import FeatureFrame, FeatureLog, KnownPoints
from rbpf.systems.mono.known_start import located_points
from rbpf.systems.mono.sightings import Sighting
from rbpf.systems.mono.video import VideoRun


class Measured(NamedTuple):
    """Names (K,) and places (K, 2) of a frame's features, px."""

    names: np.ndarray
    px: np.ndarray


def feature_log(run: VideoRun) -> FeatureLog:
    """The measurements that a run's filter used, and those that started features; names are rows of its table.

    Of a frame in which too little agreed to be trusted nothing was used, and nothing is told.
    """
    frames, count = [], 0
    noise = run.config.search.noise_px**2 * np.eye(2)
    for t, sighting in enumerate(run.sightings.frames):
        measured = _measured(sighting, count, bool(run.found[t]))
        count += sighting.started.shape[0]
        cov = np.tile(noise, (measured.names.size, 1, 1))
        frames.append(FeatureFrame(int(run.stamps_ns[t]), measured.names, measured.px, cov))
    return FeatureLog(run.sequence.name, run.sequence.camera, frames, known_points(run), run.sequence.truth)


def known_points(run: VideoRun) -> KnownPoints | None:
    """The known points under the names that they have in the log."""
    if run.mapped is not None:
        return run.mapped.points
    if run.known is None:
        return None
    return located_points(run.sequence.camera, run.known, run.config.search.noise_px)[0]


def _measured(sighting: Sighting, count: int, trusted: bool) -> Measured:
    found = sighting.found & trusted
    started = np.arange(count, count + sighting.started.shape[0])
    return Measured(
        np.concatenate([sighting.rows[found], started]),
        np.concatenate([sighting.px[found], sighting.started]),
    )
