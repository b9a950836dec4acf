"""What a run over images measured, as a log of features: for batch adjustment, for files, to filter it again."""

from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.systems.mono.video import VideoRun


def feature_log(run: VideoRun) -> FeatureLog:
    """The measurements that a run's filter used, and those that started features; names are rows of its table.

    See `VideoRun.measured`.
    """
    return FeatureLog(
        run.sequence.name, run.sequence.camera, run.measured(), known_points(run), run.sequence.truth
    )


def known_points(run: VideoRun) -> KnownPoints | None:
    """The known points under the names that they have in the log."""
    return run.slam.known_points
