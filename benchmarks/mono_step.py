"""One frame of monocular SLAM on features: 50 particles, 25 measurements, against its NumPy twin."""

from collections.abc import Iterator
from dataclasses import replace

from benchmarks.rows import Row, Settings, interleaved
from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.core.filter import Filter
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.slam import MonoSlam

SETTLING = 100
"""Frames before the timed ones, after which the map has points and rays."""


class Walk:
    """A filter that processes a log frame by frame."""

    def __init__(self, log: FeatureLog, config: MonoConfig) -> None:
        self._frames: Iterator[FeatureFrame] = iter(log.frames)
        slam = MonoSlam(log.camera, config, log.known)
        slam.take(next(self._frames))
        self.filter: Filter = slam.filter
        for _ in range(SETTLING - 1):
            self()

    def __call__(self) -> None:
        """Processes one frame."""
        frame = next(self._frames)
        self.filter.step(frame, None, frame.stamp_ns)


def run(settings: Settings) -> list[Row]:
    """Median over the frames of the desk."""
    turns = settings.repetitions(300)
    log = simulate_features(DeskWorld(frames=SETTLING + turns + 3), Measuring(), MONO, 0)
    config = MonoConfig(particles=50, map="particles")
    contestants = {"rbpf": Walk(log, config), "twin": Walk(log, replace(config, compiled=False))}
    times = interleaved(contestants, turns)
    ours, twin = times["rbpf"].median * 1e3, times["twin"].median * 1e3
    fastest = 1e3 * times["rbpf"].seconds.min()
    return [
        Row(
            "mono step, 50 particles, 25 measurements",
            ours,
            "ms",
            "its NumPy twin",
            twin,
            twin / ours,
            notes=f"the filter's part of a frame; fastest {fastest:.3g} ms, {times['rbpf'].spread}",
        )
    ]
