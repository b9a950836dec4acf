"""How far is the filter from the best that its measurements allow? A table of filter and batch errors.

Each recording is filtered with several seeds; GTSAM adjusts the very measurements that each run used. A ratio of 1 is
perfect, up to 1.5 is the goal. Where recordings lie is told by the environment variable RBPF_DATA; those that are not
there are passed over. A simulated log and a rendered desk are always in the table.
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
"""Of a table of `ErrorRatio.row`."""

ROBUST = 1.345
"""Huber's threshold for a camera's batch, which no wrong match may spoil, in standard deviations."""

LEAST = 3
"""Instants with a true pose that an alignment needs."""


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
    """Filters a robot's log with each seed, and solves its batch problem.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    log = open_log(recording, config.noise)
    errors = _over_seeds(lambda seed: filter_opened(open_robot_log(log, _seeded(config, seed))), seeds)
    return ErrorRatio(log.name, config.particles, *errors, "rigid")


def camera_ratio(recording: MonoRecording, config: MonoConfig, seeds: Sequence[int] = (0,)) -> ErrorRatio:
    """Filters a sequence of images with each seed, and adjusts what each measured in batch.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    name, known = recording.images.resolve().name, recording.known_points is not None
    errors = _over_seeds(lambda seed: filter_recording(recording, _seeded(config, seed)), seeds)
    return ErrorRatio(name, config.particles, *errors, "rigid" if known else "similarity")


def stereo_ratio(recording: StereoRecording, config: StereoConfig, seeds: Sequence[int] = (0,)) -> ErrorRatio:
    """Filters pairs of images with each seed, and adjusts the pixels that each used.

    Raises:
        InputError: the recording is wrong, or has too little ground truth.
    """
    name = f"{recording.pairs.resolve().name} (stereo)"
    errors = _over_seeds(lambda seed: filter_recording(recording, _seeded(config, seed)), seeds)
    return ErrorRatio(name, config.particles, *errors, "rigid")


def tracks_ratio(
    log: FeatureLog, config: StereoConfig, seeds: Sequence[int] = (0,), start: Array | None = None
) -> ErrorRatio:
    """Filters named pixels of a stereo pair without ground truth, beside the optimum of the same pixels.

    What the optimum is off by is taken from its own covariance: the root b of the mean trace of its positions'. What
    the filter is off by is then √(b² + d²), d its distance from the optimum (rms).

    Args:
        log: the pixels.
        config: of the filter.
        seeds: of it.
        start: (T, 7) where the batch begins; the filter's path by default.

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
    """Root mean square distance from the truth, at the instants that both have.

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
"""Noise of a match in rendered images, nearly: told one pixel the filter weighs its measurements too little."""


def main(quick: bool = False, out: Path = Path("out"), seeds: int = 5) -> dict[str, float]:
    """Prints the table, and writes it and its picture to a folder; `quick` takes the simulated worlds, made small."""
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        found = list(simulated(Path(folder), quick, 1 if quick else seeds))
    if not quick:
        found += recorded(Path(os.environ.get("RBPF_DATA", "../shared/data")), seeds)
    write_table(out / "error_ratios.csv", HEADER, [ratio.row() for ratio in found])
    save_figures({"error_ratios.png": picture(found)}, out)
    return {ratio.recording: ratio.ratio for ratio in found}


def simulated(folder: Path, quick: bool, seeds: int) -> Iterator[ErrorRatio]:
    """A robot's log and a rendered desk, of which everything is known."""
    simulate_robot(RobotWorld(steps=60 if quick else 200, landmarks=25), folder / "simulated_robot", seed=0)
    yield robot_ratio(folder / "simulated_robot", RangeBearingConfig(map="particles"), range(seeds))
    width, frames = (320, 30) if quick else (640, 300)
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, width / 2 - 0.5, 3 * width / 8 - 0.5)
    desk = folder / "rendered_desk"
    simulate_images(TexturedDesk(frames=frames), Imaging(known=6), camera, desk, seed=0)
    told = MonoConfig(search=SearchConfig(noise_px=RENDERED_PX))
    yield camera_ratio(MonoRecording(desk, desk / "known_points.csv"), told, range(seeds))


def recorded(data: Path, seeds: int) -> Iterator[ErrorRatio]:
    """The recordings that are there."""
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
    """Filter and batch side by side, on a logarithmic scale."""
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
