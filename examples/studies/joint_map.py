"""Consistency after loop closure: the joint map compared with per-particle maps and with a joint EKF.

Simulated: a robot drives loops among landmarks in the plane, and every filter has the same logs. NEES per degree of freedom
is 1 for a consistent filter; errors persist over a loop, so that one run is hardly more than one sample: the mean over runs
is compared with the EKF's, with its standard error. Recorded: logs with ground truth, several seeds of the filter. Stereo:
two laps of a room, compared with the batch of the same pixels: association is known, and each pixel is used once.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.consistency_runs import Consistency, Mean, RobotTrial, Trial, camera_trial, run_trials
from examples.studies.joint_ekf import joint_ekf
from examples.studies.parallel import in_parallel
from examples.studies.point_worlds import STEREO, Measuring, RoomWorld, simulate_features
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.runs.truth import RunTruth, truth_at
from rbpf.sensors.readers import RobotLog, open_log
from rbpf.sensors.readers.measurements import InitialEstimate, Measurements
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.stereo.config import MapConfig, OdometryConfig, StereoConfig, TriggerConfig
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.gtsam.camera import solve_features
from rbpf.validation.gtsam.robot import solve
from rbpf.validation.metrics.scores import score_estimate
from rbpf.validation.simulation.robot import RobotWorld, simulated_log

JOINT = RangeBearingConfig(map="joint")
PARTICLES = RangeBearingConfig(map="particles", likelihood=LikelihoodConfig("gaussian"))
"""Of the same likelihood."""
RECORDINGS = ("mrpt_kf_slam_2d", "mrpt_kf_slam_6d", "mrclam6_robot1")


def loops(steps: int, std_rotation_deg: float = 0.3) -> RobotWorld:
    """Two laps of 50 m in the plane, a dozen landmarks in view; with a given heading noise of the odometry."""
    return RobotWorld(
        steps=steps, landmarks=100, radius_m=8.0, laps=2.0, extent_m=12.0, max_range_m=4.5, half_field_of_view_deg=180.0,
        std_range_m=0.05, std_angle_deg=1.0, std_translation_m=0.02, std_rotation_deg=std_rotation_deg,
    )  # fmt: skip


MANY = RobotWorld(
    steps=1500, landmarks=800, radius_m=20.0, laps=2.0, extent_m=28.0, max_range_m=4.5, half_field_of_view_deg=180.0,
    std_range_m=0.05, std_angle_deg=1.0, std_translation_m=0.02, std_rotation_deg=0.3,
)  # fmt: skip
"""Two laps of 125 m: more landmarks than one Gaussian can process quickly."""
LONG = replace(MANY, steps=20_000, laps=20_000 / 750)
"""The same area for a long time, with three hundred landmarks coming into view."""
OF_MANY = {
    **{f"joint map, sub-maps of {n}": replace(JOINT, submap=n) for n in (50, 150)},
    "joint map, one": replace(JOINT, submap=None),
    "particles": PARTICLES,
}


@dataclass(frozen=True)
class EkfTrial:
    """The joint EKF on the logs of a world; called with a seed."""

    world: RobotWorld

    def __call__(self, seed: int) -> Trial:
        """Simulates and filters."""
        log = simulated_log(self.world, seed)
        return of_ekf(log)


def measured_in(log: RobotLog) -> tuple[Measurements, RunTruth]:
    """A filter's measurements of a log with ground truth at all steps, and the ground truth."""
    done = filter_opened(open_robot_log(log, replace(JOINT, particles=1, window=1)))
    assert log.truth is not None
    truth = truth_at(log.space, log.truth, done.log.stamps_ns, "first frame")
    assert truth is not None
    return done.system.measurements(log.name, done.log), truth


def of_ekf(log: RobotLog) -> Trial:
    """One Gaussian of pose and landmarks, linearised once per step."""
    measured, truth = measured_in(log)
    found = joint_ekf(measured)
    errors = whitened_errors(log.space, found.world_from_robot, found.cov_poses, truth.poses)
    landmarks = []
    for name, point in found.landmarks.items():
        error = point - truth.landmarks[name]
        landmarks.append(error @ np.linalg.solve(found.cov_landmarks[name], error))
    nothing, dim = np.full(len(errors.nees), np.nan), log.space.dim
    shift = log.space.translation(found.world_from_robot) - log.space.translation(truth.poses)
    return Trial(
        dim, np.linalg.norm(shift, axis=1), np.where(errors.ranks > 0, errors.nees, np.nan), nothing, nothing,
        np.array(landmarks), shift.shape[1], nothing, None, found.log_evidence,
    )  # fmt: skip


def of_batch(log: RobotLog) -> float:
    """Position error of the batch optimum, rms in metres."""
    measured, truth = measured_in(log)
    found = solve(measured, marginals=False, incremental=True)
    shift = log.space.translation(found.world_from_body) - log.space.translation(truth.poses)
    return float(np.sqrt((shift**2).sum(axis=1).mean()))


def simulated(
    world: RobotWorld, runs: int, particles: tuple[int, ...], windows: tuple[int, ...], workers: int
) -> dict[str, Consistency]:
    """All filters on the same logs."""
    trials: dict[str, Any] = {"joint EKF": EkfTrial(world)}
    for n in particles:
        for window in windows:
            trials[f"joint, {n} particles, window {window}"] = RobotTrial(
                world, replace(JOINT, particles=n, window=window)
            )
        trials[f"particles, {n}"] = RobotTrial(world, replace(PARTICLES, particles=n))
    return {name: run_trials(trial, range(runs), workers) for name, trial in trials.items()}


def rows_of(world: str, found: dict[str, Consistency], beside: str = "joint EKF") -> list[list[str | int | float]]:
    """A row per filter: evidence and error relative to another's on the same run."""
    other, rows = found[beside].trials, list[list[str | int | float]]()
    for name, consistency in found.items():
        evidence = [own.log_evidence - its.log_evidence for own, its in zip(consistency.trials, other, strict=True)]
        inside = consistency.coverage(0.95)
        rows.append([
            world, name, len(evidence), consistency.pose_nees.value, consistency.pose_nees.error,
            100.0 * inside.value, 100.0 * inside.error, consistency.landmark_nees.value,
            consistency.position_rmse.value, float(np.mean(evidence)),
        ])  # fmt: skip
    return rows


def recorded(folder: Path, seeds: int, configs: dict[str, RangeBearingConfig]) -> list[list[str | int | float]]:
    """Per recording and filter: mean and spread over the seeds, metres."""
    rows = list[list[str | int | float]]()
    for recording in RECORDINGS:
        log = open_log(folder / recording)
        aligned = "mrclam" in recording
        names = ("ate_rmse_m", "landmark_error_aligned_mean_m") if aligned else ("path_rmse_m", "landmark_error_mean_m")
        for name, config in configs.items():
            errors, evidence, speed = [], [], []
            for seed in range(seeds):
                done = filter_opened(open_robot_log(log, replace(config, seed=seed)))
                scores = score_estimate(PathAndMap.of_run(done), done.truth, False)
                errors.append([scores[key] for key in names])
                evidence.append(float(done.log["log_evidence"].sum()))
                speed.append(1e3 * float(np.median(done.log["seconds"])))
            mean, spread = np.mean(errors, axis=0), np.ptp(errors, axis=0)
            rows.append(
                [recording, name, seeds, mean[0], spread[0], mean[1], spread[1], float(np.ptp(evidence)), min(speed)]
            )
    return rows


_EVERY_PAIR = replace(
    StereoConfig.s05(), trigger=TriggerConfig(0.0, 0.0), likelihood=LikelihoodConfig("gaussian"), calibrate="off"
)
STEREO_FILTERS = {
    "joint, 50 particles": replace(_EVERY_PAIR, particles=50, map=MapConfig(kind="joint")),
    "particles, 400": replace(
        _EVERY_PAIR,
        proposal=ProposalConfig(),
        odometry=OdometryConfig(role="proposal"),
        map=MapConfig(kind="particles", weigh="all"),
    ),
}
"""Of the same likelihood, and with each pixel once."""


class RoomRun(NamedTuple):
    """One filter in one room; root mean square errors in metres, not aligned."""

    trial: Trial
    map_error: float
    batch_path_error: float
    batch_map_error: float
    milliseconds: float  #: per pair.


@dataclass(frozen=True)
class RoomTrial:
    """Stereo SLAM on the pixels of a room, 15 points of 0.5 px in a pair, and their batch; called with a seed."""

    world: RoomWorld
    config: StereoConfig

    def __call__(self, seed: int) -> RoomRun:
        """Simulates, filters, and computes the batch optimum."""
        measuring = Measuring(
            noise_px=0.5, measurements=15, known=0, new_per_frame=15, nearest_m=0.5, farthest_m=7.0, dropout=0.0,
            turnover=0.0, occlusion=False,
        )  # fmt: skip
        log = simulate_features(self.world, measuring, STEREO, seed)
        begun = time.process_time()
        done = filter_features(log, replace(self.config, seed=seed))
        seconds, truth = time.process_time() - begun, done.truth
        assert truth is not None
        batch = solve_features(log, InitialEstimate(done.log.poses, {}), marginals=False)
        path = SE3.between(batch.world_from_body[0], batch.world_from_body)
        off = np.linalg.norm(SE3.translation(path) - SE3.translation(truth.poses), axis=1)
        maps = [
            [np.linalg.norm(point - truth.landmarks[name]) for name, point in landmarks.items()]
            for landmarks in (done.system.map().named(), batch.landmarks)
        ]
        ours, theirs, batch_path = (float(np.sqrt(np.square(errors).mean())) for errors in (*maps, off))
        return RoomRun(camera_trial(log, done), ours, batch_path, theirs, 1e3 * seconds / len(log.frames))


def rooms(world: RoomWorld, runs: int, workers: int) -> list[list[str | int | float]]:
    """A row per filter: means over the runs."""
    rows = list[list[str | int | float]]()
    for name, config in STEREO_FILTERS.items():
        found = in_parallel(RoomTrial(world, config), range(runs), workers)
        consistency = Consistency([run.trial for run in found])
        inside, ratio = consistency.coverage(0.95), Mean.of([run.map_error / run.batch_map_error for run in found])
        rows.append([
            name, runs, consistency.pose_nees.value, consistency.pose_nees.error, 100.0 * inside.value,
            100.0 * inside.error, consistency.landmark_nees.value, consistency.position_rmse.value,
            float(np.mean([run.batch_path_error for run in found])), float(np.mean([run.map_error for run in found])),
            ratio.value, ratio.error, min(run.milliseconds for run in found),
        ])  # fmt: skip
    return rows


def draw(found: dict[str, Consistency], out: Path) -> None:
    """Plots the mean NEES of all filters over time."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    axes = figure.subplots()
    first = next(iter(found.values()))
    band = first.band()
    axes.axhspan(band.low / first.dim, band.high / first.dim, color="tab:green", alpha=0.25, label="95 % band")
    for name, consistency in found.items():
        axes.plot(consistency.mean_nees / first.dim, lw=1.0, label=name)
    axes.set(xlabel="step", ylabel="NEES / d", yscale="log", title=f"mean of {len(first.trials)} runs")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)
    figure.savefig(out / "joint_map.png", dpi=110)


def main(
    runs: int = 10,
    steps: int = 400,
    particles: tuple[int, ...] = (50, 250),
    windows: tuple[int, ...] = (1, 5),
    many_runs: int = 0,
    long_runs: int = 0,
    recordings: Path | None = None,
    seeds: int = 3,
    room_runs: int = 10,
    frames: int = 600,
    workers: int = 1,
    out: Path = Path("demo/joint_map"),
    quick: bool = False,
) -> dict[str, float]:
    """Prints the tables; returns the mean NEES of every filter's poses, and the error of its map relative to the batch's.

    Args:
        runs: number of simulated logs of a robot, with seeds 0, 1, ….
        steps: of each.
        particles: numbers of particles.
        windows: of the joint map.
        many_runs: number of logs with 800 landmarks, compared with one Gaussian of all; each takes minutes.
        recordings: folder of the recorded logs; None skips them.
        seeds: number of seeds of the filter on each recording, 0, 1, ….
        long_runs: number of logs of 20,000 steps among 300 landmarks; each takes ten minutes.
        room_runs: number of stereo runs in a room, with seeds 0, 1, ….
        frames: of each.
        workers: processes.
        out: folder for plot and tables.
        quick: one short log and few particles.
    """
    if quick:
        runs, steps, particles, windows, room_runs, frames = 2, 80, (20,), (1,), 1, 40
    out.mkdir(parents=True, exist_ok=True)
    results = dict[str, float]()
    if room_runs:
        header = [
            "filter", "runs", "NEES / d", "± s.e.", "in 95 % [%]", "± s.e.", "landmarks", "path [m]", "batch",
            "map [m]", "beside the batch", "± s.e.", "ms per pair",
        ]  # fmt: skip
        in_rooms = rooms(RoomWorld(frames=frames, laps=frames / 300), room_runs, workers)
        write_table(out / "joint_map_stereo.csv", header, in_rooms)
        results = {
            f"stereo {row[0]}: {what}": float(row[at]) for row in in_rooms for at, what in ((2, "NEES"), (10, "map"))
        }
    if not runs:
        return results
    found = simulated(loops(steps), runs, particles, windows, workers)
    rows = rows_of("0.3° per step", found)
    if not quick:
        rows += rows_of("2° per step", simulated(loops(steps, 2.0), runs, particles[:1], windows, workers))
    header = [
        "heading noise", "filter", "runs", "NEES / d", "± s.e.", "in 95 % [%]", "± s.e.", "landmarks", "path [m]",
        "log-evidence − EKF",
    ]  # fmt: skip
    if many_runs:
        many = {
            name: run_trials(RobotTrial(MANY, config), range(many_runs), workers) for name, config in OF_MANY.items()
        }
        rows += rows_of("800 landmarks", many, "joint map, one")
    if long_runs:
        trials = {"joint EKF": EkfTrial(LONG), "joint map, sub-maps of 150": RobotTrial(LONG, JOINT)}
        long = {name: run_trials(trial, range(long_runs), workers) for name, trial in trials.items()}
        rows += rows_of("20,000 steps", long)
        batch = [of_batch(simulated_log(LONG, seed)) for seed in range(long_runs)]
        rows.append(["20,000 steps", "batch", long_runs, *[np.nan] * 5, float(np.mean(batch)), np.nan])
    write_table(out / "joint_map.csv", header, rows)
    if recordings is not None:
        configs = {f"joint, 50, window {w}": replace(JOINT, particles=50, window=w) for w in windows}
        configs["particles, 100"] = PARTICLES
        header = [
            "recording", "filter", "seeds", "path [m]", "range", "landmarks [m]", "range", "log-evidence, range",
            "ms per step",
        ]  # fmt: skip
        write_table(out / "joint_map_recordings.csv", header, recorded(recordings, seeds, configs))
    draw(found, out)
    print(f"picture and tables in {out}")
    return results | {str(row[1]): float(row[3]) for row in rows if row[0] == "0.3° per step"}


if __name__ == "__main__":
    tyro.cli(main)
