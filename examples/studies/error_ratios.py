"""Errors of filters relative to the batch optimum of their measurements, as a table.

Each recording is filtered with several seeds; GTSAM adjusts the same measurements as used in each run. A ratio of 1 is
optimal, up to 1.5 is the goal. Recordings are in the folder of the environment variable RBPF_DATA; missing ones are
skipped. A simulated log and a rendered desk are always in the table.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np

from examples.studies.stereo_tracks import read_stereo_tracks
from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.files import write_table
from rbpf.runs.plots import COLOURS, new_axes, save_figures
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import (
    MonoRecording,
    StereoRecording,
    filter_features,
    filter_opened,
    filter_recording,
    open_robot_log,
)
from rbpf.runs.run import Run
from rbpf.runs.trajectory import Alignment, Trajectory, associate, in_space
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers import open_log
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.gtsam.batch_problem import Optimum, floats_in_scale, solve_problem
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

HEADER = ("recording", "particles", "seeds", "filter_m", "least_m", "most_m", "batch_m", "ratio")
"""Columns of `ErrorRatio.row`."""

ROBUST = 1.345
"""Huber's threshold for a camera's batch, for robustness to outliers, in standard deviations."""

LEAST = 3
"""Least number of true poses for an alignment."""


@final
@dataclass(frozen=True)
class ErrorRatio:
    """Errors of filter and batch on one recording.

    Attributes:
        recording: its name.
        particles: of the filter.
        filter_errors_m: root mean square position error of each seed.
        batch_errors_m: of the optimum of each seed's measurements.
        alignment: before both.
    """

    recording: str
    particles: int
    filter_errors_m: tuple[float, ...]
    batch_errors_m: tuple[float, ...]
    alignment: Alignment

    @property
    def ratio(self) -> float:
        """Median over the seeds of the filter's error over the batch's."""
        return float(np.median(np.divide(self.filter_errors_m, self.batch_errors_m)))

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"ratio": self.ratio}

    def row(self) -> tuple[str, int, int, float, float, float, float, float]:
        """For a table with `HEADER`."""
        ours = self.filter_errors_m
        middle, batch = float(np.median(ours)), float(np.median(self.batch_errors_m))
        return self.recording, self.particles, len(ours), middle, min(ours), max(ours), batch, self.ratio


def robot_ratio(recording: Path, config: RangeBearingConfig, seeds: Sequence[int] = (0,)) -> ErrorRatio:
    """Filters a robot's log with each seed, and computes its batch optimum.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    log = open_log(recording, config.noise)
    errors = _over_seeds(lambda seed: filter_opened(open_robot_log(log, _seeded(config, seed))), seeds)
    return ErrorRatio(log.name, config.particles, *errors, "rigid")


def camera_ratio(recording: MonoRecording, config: MonoConfig, seeds: Sequence[int] = (0,)) -> ErrorRatio:
    """Filters a sequence of images with each seed, and adjusts the measurements of each in batch.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    name, known = recording.images.resolve().name, recording.known_points is not None
    errors = _over_seeds(lambda seed: filter_recording(recording, _seeded(config, seed)), seeds)
    return ErrorRatio(name, config.particles, *errors, "rigid" if known else "similarity")


def stereo_ratio(recording: StereoRecording, config: StereoConfig, seeds: Sequence[int] = (0,)) -> ErrorRatio:
    """Filters pairs of images with each seed, and adjusts the pixels used by each.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    name = f"{recording.pairs.resolve().name} (stereo)"
    errors = _over_seeds(lambda seed: filter_recording(recording, _seeded(config, seed)), seeds)
    return ErrorRatio(name, config.particles, *errors, "rigid")


def tracks_ratio(
    log: FeatureLog, config: StereoConfig, seeds: Sequence[int] = (0,), start: Array | None = None
) -> ErrorRatio:
    """Filters named pixels of a stereo pair without ground truth, and compares with the optimum of the same pixels.

    The optimum's error is taken from its covariance: b, the root of the mean trace of its positions' covariances. The
    filter's error is then √(b² + d²), with d its distance from the optimum (rms).

    Args:
        log: the pixels.
        config: of the filter.
        seeds: of it.
        start: (T, 7) initial path of the batch; by default the filter's.

    Raises:
        InputError: the log is of one camera, or the batch does not converge.
    """
    ours, batch = [], []
    optimum: Optimum | None = None
    for seed in seeds:
        found = filter_features(log, _seeded(config, seed))
        if optimum is None:
            begin = found.log.poses if start is None else start[: len(found.log)]
            optimum = solve_problem(found.system.measurements(found.name, found.log), begin)
        path = optimum.estimate
        off = ate(PathAndMap.of_run(found).at(optimum.steps).trajectory, path.trajectory).rmse
        spread = float(np.sqrt(np.trace(path.cov_poses[:, 3:, 3:], axis1=1, axis2=2).mean()))
        ours.append(float(np.hypot(off, spread)))
        batch.append(spread)
    return ErrorRatio(log.name, config.particles, tuple(ours), tuple(batch), "none")


def error_of(estimate: PathAndMap, truth: Trajectory, alignment: Alignment) -> float:
    """Root mean square distance from the truth, at common instants.

    Raises:
        InputError: they share none, or too few to align them.
    """
    ours, theirs = associate(estimate.trajectory, truth, 0)
    if len(ours) < LEAST:
        raise InputError(f"path and truth share {len(ours)} time stamps, expected {LEAST} or more to align them.")
    return ate(ours, theirs, alignment).rmse


def _over_seeds(filtered: Callable[[int], Run], seeds: Sequence[int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    ours, batch, optimum = [], [], None
    for seed in seeds:
        found = filtered(seed)
        estimate, truth = PathAndMap.of_run(found), _truth(found)
        problem = found.system.measurements(found.name, found.log)
        alignment: Alignment = "similarity" if floats_in_scale(problem) else "rigid"
        if optimum is None or isinstance(problem, FeatureLog):
            robust = ROBUST if isinstance(problem, FeatureLog) else None
            optimum = solve_problem(problem, estimate.world_from_body, robust, marginals=False)
        ours.append(error_of(estimate, truth, alignment))
        batch.append(error_of(optimum.estimate, truth, alignment))
    return tuple(ours), tuple(batch)


def _truth(found: Run) -> Trajectory:
    if found.truth is None:
        raise InputError(f"{found.name} has no ground truth to tell the errors by, or too little.")
    return in_space(found.log.stamps_ns[found.truth.rows], found.truth.poses)


def _seeded(config: Any, seed: int) -> Any:
    return replace(config, seed=seed)


ROBOTS = "mrpt_kf_slam_2d", "mrpt_kf_slam_6d", "mrclam6_robot1"
CAMERAS = "mono_redkitchen_a", "stereo_zed_room1"
PAIRS = "stereo_zed_room1", "stereo_kitti_seq1"
TRACKS = "gtsam_stereo_vo"
RENDERED_PX = 0.25
"""Approximate noise of a match in rendered images: with one pixel the filter would underweigh its measurements."""


def main(quick: bool = False, out: Path = Path("out"), seeds: int = 5) -> dict[str, float]:
    """Prints the table, and writes it and its plot to a folder; `quick` uses small simulated worlds."""
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        found = list(simulated(Path(folder), quick, 1 if quick else seeds))
    if not quick:
        found += recorded(Path(os.environ.get("RBPF_DATA", "../shared/data")), seeds)
    write_table(out / "error_ratios.csv", HEADER, [ratio.row() for ratio in found])
    save_figures({"error_ratios.png": picture(found)}, out)
    return {ratio.recording: ratio.ratio for ratio in found}


def simulated(folder: Path, quick: bool, seeds: int) -> Iterator[ErrorRatio]:
    """A simulated robot's log and a rendered desk."""
    simulate_robot(RobotWorld(steps=60 if quick else 200, landmarks=25), folder / "simulated_robot", seed=0)
    yield robot_ratio(folder / "simulated_robot", RangeBearingConfig(map="particles"), range(seeds))
    width, frames = (320, 30) if quick else (640, 300)
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, width / 2 - 0.5, 3 * width / 8 - 0.5)
    desk = folder / "rendered_desk"
    simulate_images(TexturedDesk(frames=frames), Imaging(known=6), camera, desk, seed=0)
    told = MonoConfig(search=SearchConfig(noise_px=RENDERED_PX))
    yield camera_ratio(MonoRecording(desk, desk / "known_points.csv"), told, range(seeds))


def recorded(data: Path, seeds: int) -> Iterator[ErrorRatio]:
    """The available recordings."""
    for name in ROBOTS:
        if (data / name).is_dir():
            yield robot_ratio(data / name, RangeBearingConfig(map="particles"), range(seeds))
    for name in PAIRS:
        if (data / name).is_dir():
            yield stereo_ratio(StereoRecording(data / name), StereoConfig.s05(), range(seeds))
    if (data / TRACKS).is_dir():
        tracks = read_stereo_tracks(data / TRACKS)
        yield tracks_ratio(tracks.log, StereoConfig.s05(), range(seeds), tracks.world_from_camera)
    for name in CAMERAS:
        if (data / name).is_dir():
            yield camera_ratio(MonoRecording(data / name, data / name / "known_points.csv"), MonoConfig(), range(seeds))


def picture(found: list[ErrorRatio]):
    """Plots filter and batch side by side, on a logarithmic scale."""
    figure, axes = new_axes("filter beside the batch optimum", "position error [m]", "")
    places = range(len(found))
    names = {"filter": [ratio.row()[3] for ratio in found], "batch": [ratio.row()[6] for ratio in found]}
    for shift, (name, errors) in zip((-0.2, 0.2), names.items(), strict=True):
        axes.bar([place + shift for place in places], errors, 0.38, color=COLOURS[name], label=name)
    axes.set_yscale("log")
    axes.set_xticks(list(places), [ratio.recording for ratio in found], rotation=20, ha="right")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
