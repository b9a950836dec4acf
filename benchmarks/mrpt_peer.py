"""Comparison with MRPT's EKF-SLAM (`kf-slam`) on a log simulated by MRPT: the same observations, known association.

A joint EKF is not a particle filter: this row compares time per step and map error where both apply, with few
landmarks.
"""

import re
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np

from benchmarks.rows import Row, Settings, SkippedError, Timing, interleaved
from rbpf.core.filter import Filter
from rbpf.lie import SE2
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing

N = 50
STEPS, LANDMARKS = 250, 70
STD_RANGE, STD_YAW_DEG = 0.02, 0.2
STD_XY, STD_PHI_DEG = 0.01, 0.2
PROGRAMS = ("kf-slam", "simul-landmarks", "rawlog-edit")
_STEP = re.compile(r"\[(\d+):(\d+):([\d.]+)\|.*Step \d+ - ")
_ERROR = re.compile(r"Mean Error: ([\d.]+) meters")

SIMULATION = f"""[Params]
outDir = .
outFile = log.rawlog
nSteps = {STEPS}
circularPath = 1
minSensorDistance = 1
maxSensorDistance = 10
fieldOfView_deg = 180
odometryNoiseXY_std = {STD_XY}
odometryNoisePhi_std_deg = {STD_PHI_DEG}
stdRange = {STD_RANGE}
stdYaw_deg = {STD_YAW_DEG}
stdPitch_deg = 0
[RANDOMSET_1]
nLandmarks = {LANDMARKS}
min_x = -8
max_x = 8
min_y = -6
max_y = 10
"""
EKF_SLAM = f"""[MappingApplication]
kf_implementation = CRangeBearingKFSLAM2D
rawlog_file = log.rawlog
ground_truth_file = log.rawlog_ground_truth.txt
ground_truth_file_robot = log.rawlog_ground_truth_robot_path.txt
logOutput_dir = kf_slam
SAVE_LOG_FREQUENCY = {STEPS}
SHOW_3D_LIVE = false
SAVE_3D_SCENES = false
SAVE_MAP_REPRESENTATIONS = false
SAVE_DA_LOG = false
[RangeBearingKFSLAM_KalmanFilter]
method = 0
verbosity_level = WARN
[RangeBearingKFSLAM]
force_ignore_odometry = false
std_sensor_range = {STD_RANGE}
std_sensor_yaw_deg = {STD_YAW_DEG}
"""


def call(folder: Path, *command: str) -> str:
    """Standard output of a program run in the folder."""
    done = subprocess.run(
        command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False
    )
    return done.stdout + done.stderr


def run(settings: Settings) -> list[Row]:
    """Time per step of both, and the mean error of both maps."""
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        raise SkippedError(f"{missing[0]} is not installed (Debian's mrpt-apps has it)")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "simulation.ini").write_text(SIMULATION)
        (folder / "ekf_slam.ini").write_text(EKF_SLAM)
        call(folder, "simul-landmarks", "simulation.ini")
        call(folder, "rawlog-edit", "-w", "--list-range-bearing", "-i", "log.rawlog", "--text-file-output", "z.txt")
        turns = settings.repetitions(6)
        frames, landmarks = read(folder)
        output: list[str] = []
        ours: list[Filter] = []
        seconds: list[float] = []

        def filter_once() -> None:
            filter_ = make_filter(len(ours))
            step = iter(frames)
            times = interleaved({"rbpf": lambda: advance(filter_, next(step))}, len(frames) - 2)
            seconds.extend(times["rbpf"].seconds)
            ours.append(filter_)

        interleaved(
            {"rbpf": filter_once, "kf-slam": lambda: output.append(call(folder, "kf-slam", "ekf_slam.ini"))},
            turns,
            warm_up=0,
        )
    spent = Timing(np.array(seconds))
    theirs = Timing(np.concatenate([step_times(text) for text in output]))
    error = float(np.mean([map_error(filter_, landmarks) for filter_ in ours]))
    seen = np.mean([frame.landmarks.size for frame in frames])
    return [
        Row(
            "update vs MRPT kf-slam",
            spent.median * 1e3,
            "ms",
            f"EKF-SLAM, {LANDMARKS} landmarks",
            theirs.median * 1e3,
            theirs.median / spent.median,
            notes=(
                f"{N} particles, {seen:.0f} observations per step; mean error of the map: {error * 1e3:.1f} mm, "
                f"kf-slam {theirs_error(output[-1]) * 1e3:.1f} mm"
            ),
            tolerance=0.5,
            optional=True,
        )
    ]


def advance(filter_: Filter, frame: SimpleNamespace) -> None:
    filter_.step(frame, frame.control)


def make_filter(seed: int) -> Filter:
    sensor = NamedLandmarkSensor(RangeBearing(SE2), Point(2))
    return Filter(OdometryMotion(SE2), sensor, LandmarkMap(SE2), n=N, rng=np.random.default_rng(seed))


def read(folder: Path) -> tuple[list[SimpleNamespace], dict[int, np.ndarray]]:
    """Frames with odometry sampled from the simulation's model, and the true landmarks by number."""
    rows = np.loadtxt(folder / "z.txt", comments="%")
    path = np.loadtxt(folder / "log.rawlog_ground_truth_robot_path.txt", comments="%")[:, [3, 0, 1]]
    truth = np.loadtxt(folder / "log.rawlog_ground_truth.txt")
    rng = np.random.default_rng(0)
    std = np.array([np.radians(STD_PHI_DEG), STD_XY, STD_XY])
    cov = np.diag([STD_RANGE, np.radians(STD_YAW_DEG)]) ** 2
    frames = []
    for t, stamp in enumerate(np.unique(rows[:, 0])):
        seen = rows[rows[:, 0] == stamp]
        control = None
        if t:
            delta = SE2.between(path[t - 1], path[t]) + std * rng.normal(size=3)
            control = Odometry(delta, np.diag(std**2))
        frames.append(
            SimpleNamespace(
                control=control,
                landmarks=seen[:, 2].astype(int),
                z=np.ascontiguousarray(seen[:, 3:5]),
                cov_z=np.repeat(cov[None], seen.shape[0], axis=0),
            )
        )
    return frames, {int(row[-1]): row[:2] for row in truth}


def step_times(output: str) -> np.ndarray:
    """Seconds between the steps of a log."""
    stamps = [3600 * float(h) + 60 * float(m) + float(s) for h, m, s in _STEP.findall(output)]
    if len(stamps) < STEPS // 2:
        raise RuntimeError(f"kf-slam did not finish: {output[-400:]}")
    return np.diff(stamps)


def theirs_error(output: str) -> float:
    found = _ERROR.search(output)
    return float(found.group(1)) if found else float("nan")


def map_error(filter_: Filter, landmarks: dict[int, np.ndarray]) -> float:
    """Mean landmark error, metres, without alignment as the start is known."""
    belief = filter_.belief()
    ids = belief.map.ids
    points, _ = belief.moments(ids)
    truth = np.array([landmarks[i] for i in ids.tolist()])
    return float(np.linalg.norm(points - truth, axis=1).mean())
