"""What a run over images measured, as a log of features: for batch adjustment, for files, to filter it again."""

from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.systems.mono.known_start import located_points
from rbpf.systems.mono.video import VideoRun


def feature_log(run: VideoRun) -> FeatureLog:
    """The measurements that a run's filter used, and those that started features; names are rows of its table.

    See `Sightings.measured`.
    """
    noise_px = run.config.search.noise_px
    frames = run.sightings.measured(run.stamps_ns, run.found, noise_px)
    return FeatureLog(run.sequence.name, run.sequence.camera, frames, known_points(run), run.sequence.truth)


def known_points(run: VideoRun) -> KnownPoints | None:
    """The known points under the names that they have in the log."""
    if run.mapped is not None:
        return run.mapped.points
    if run.known is None:
        return None
    return located_points(run.sequence.camera, run.known, run.config.search.noise_px)[0]
