"""UTIAS multi-robot data sets (MRCLAM): one robot, its odometry and its sightings of fixed landmarks.

A folder with blank-separated tables, `#` starting a comment; `Robot1` stands for any prefix:

- `Barcodes.dat`: subject, barcode. Subjects 1 to 5 are the robots, the others landmarks.
- `Robot1_Odometry.dat`: time [s], forward speed [m/s], turn rate [rad/s] (left positive). A reading holds
  from its time until the next one; before the first one the robot stands still.
- `Robot1_Measurement.dat`: time [s], barcode, range [m], bearing [rad] (from the heading, left positive).
  Its header says subject where it means barcode. Robots, which move, and unknown barcodes are left out; a
  logged message counts them.
- `Robot1_Groundtruth.dat`, `Landmark_Groundtruth.dat`, if the truth is known: time [s], x [m], y [m], heading
  [rad], and subject, x [m], y [m], standard deviations of both [m].

A frame is an instant at which at least one landmark was seen. The motion between two frames and its
covariance come from `dead_reckoning`, with the standard deviations of `DEFAULT_NOISE`, as the log names none.
A folder with several robots is read by the path of one's `..._Measurement.dat`.
K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", IJRR 30(8), 2011.
"""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE2, Array
from rbpf.sensors.readers.assembly import assemble, diagonal, require_observations
from rbpf.sensors.readers.dead_reckoning import integrate
from rbpf.sensors.readers.log import RobotLog, Truth
from rbpf.sensors.readers.noise import LogNoise
from rbpf.sensors.readers.table import Table, read_columns

KIND = (
    "an MRCLAM log (a folder with Barcodes.dat and one robot's ..._Measurement.dat and ..._Odometry.dat,"
    " or the path of that ..._Measurement.dat)"
)
DEFAULT_NOISE = LogNoise(
    std_range_m=0.12, std_bearing_rad=0.02, std_speed_mps=0.02, std_turn_rate_radps=0.04, scale_odometry=1.0
)

_LAST_ROBOT = 5
_SUFFIX = "_Measurement.dat"
_log = logging.getLogger(__name__)


def recognises(path: Path) -> bool:
    """Whether the path is a robot's table of measurements, or a folder with one or with barcodes."""
    if path.is_dir():
        return (path / "Barcodes.dat").is_file() or any(path.glob(f"*{_SUFFIX}"))
    return path.name.endswith(_SUFFIX)


def read(path: Path, noise: LogNoise) -> RobotLog:
    """Read the log of one robot.

    Args:
        path: the folder, or the robot's table of measurements in it.
        noise: standard deviations in place of `DEFAULT_NOISE`.

    Raises:
        InputError: a file is missing, a line is not as described above, or there are several robots.
    """
    noise.require_only(DEFAULT_NOISE.given(), path, "an MRCLAM log")
    noise = replace(DEFAULT_NOISE, **noise.given())
    folder, prefix = _folder_and_prefix(path)
    barcodes = _read_barcodes(folder / "Barcodes.dat")
    stamps, frame, subjects, z = _read_sightings(folder / f"{prefix}{_SUFFIX}", barcodes)
    delta, cov_delta = _read_motion(folder / f"{prefix}_Odometry.dat", stamps, noise)
    cov_z = diagonal([np.full(len(z), noise.std_range_m), np.full(len(z), noise.std_bearing_rad)])
    return RobotLog(
        name=folder.resolve().name if path.is_dir() else f"{folder.resolve().name}_{prefix}",
        space=SE2,
        measurement="range_bearing",
        robot_from_sensor=SE2.identity(),
        frames=assemble(stamps, delta, cov_delta, frame, subjects, z, cov_z),
        truth=_read_truth(folder / f"{prefix}_Groundtruth.dat", folder / "Landmark_Groundtruth.dat"),
    )


def _folder_and_prefix(path: Path) -> tuple[Path, str]:
    if not path.is_dir():
        return path.parent, path.name.removesuffix(_SUFFIX)
    robots = sorted(file.name for file in path.glob(f"*{_SUFFIX}"))
    if len(robots) != 1:
        found = f"those of {len(robots)} robots; name one, such as {path / robots[0]}" if robots else "none"
        raise InputError(f"{path}: expected {KIND}; found {found}.")
    return path, robots[0].removesuffix(_SUFFIX)


def _read_barcodes(path: Path) -> dict[int, int]:
    table = read_columns(path, ("subject", "barcode"), KIND)
    table.require(table["subject"] >= 1, "subject", "1 or more")
    return dict(zip(table.names("barcode").tolist(), table.names("subject").tolist(), strict=True))


def _read_sightings(
    path: Path, barcodes: dict[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    table = read_columns(path, ("time", "barcode", "range", "bearing"), KIND)
    require_observations(table, "range", "bearing")
    subjects = np.array([barcodes.get(barcode, 0) for barcode in table.integers("barcode").tolist()])
    kept = subjects > _LAST_ROBOT
    unknown = np.count_nonzero(subjects == 0)
    robots = len(kept) - np.count_nonzero(kept) - unknown
    _log.info("%s: left out %d sightings of robots and %d of unknown barcodes", path, robots, unknown)
    if not kept.any():
        raise InputError(f"{path}: expected sightings of landmarks, found no barcode of one.")
    stamps, frame = np.unique(table.stamps_ns()[kept], return_inverse=True)
    return stamps, frame, subjects[kept], table.block("range", "bearing")[kept]


def _read_motion(path: Path, stamps_ns: NDArray[np.int64], noise: LogNoise) -> tuple[Array, Array]:
    table = read_columns(path, ("time", "forward speed", "turn rate"), KIND)
    readings_ns = table.stamps_ns()
    _require_odometry_until(table, readings_ns, int(stamps_ns[-1]))
    delta, cov = integrate(readings_ns, table["turn rate"], table["forward speed"], stamps_ns)
    variance = np.square(np.array([noise.std_turn_rate_radps, noise.std_speed_mps], dtype=float))
    return delta, noise.odometry_variance_factor() * np.einsum("tsab,s->tab", cov, variance)


def _require_odometry_until(table: Table, readings_ns: NDArray[np.int64], last_ns: int) -> None:
    # Holding the last reading longer than any reading was ever held would invent motion.
    longest = int(np.diff(readings_ns).max(initial=0))
    late = last_ns - int(readings_ns[-1])
    if late > longest:
        problem = f"the odometry ends {late / 1e9:.3f} s before the last sighting, expected it to last longer"
        raise table.error(len(readings_ns) - 1, problem)


def _read_truth(path_file: Path, landmark_file: Path) -> Truth | None:
    if not path_file.exists() and not landmark_file.exists():
        return None
    stamps, poses = np.empty(0, dtype=np.int64), np.empty((0, 3))
    landmarks: dict[int, np.ndarray] = {}
    if path_file.exists():
        table = read_columns(path_file, ("time", "x", "y", "heading"))
        stamps, poses = table.stamps_ns(), SE2.normalise(np.roll(table.block("x", "heading"), 1, axis=1))
    if landmark_file.exists():
        table = read_columns(landmark_file, ("subject", "x", "y", "std of x", "std of y"))
        for column in ("std of x", "std of y"):
            table.require(table[column] >= 0, column, "zero or positive")
        landmarks = dict(zip(table.names("subject").tolist(), table.block("x", "y"), strict=True))
    return Truth(stamps, poses, landmarks)
