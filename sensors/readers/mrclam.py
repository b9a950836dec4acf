"""UTIAS multi-robot data sets (MRCLAM): one robot, its odometry and its observations of fixed landmarks.

A folder with blank-separated tables, `#` starting a comment; `Robot1` stands for any prefix:

- `Barcodes.dat`: subject, barcode. Subjects 1 to 5 are the robots, the others landmarks.
- `Robot1_Odometry.dat`: time [s], forward speed [m/s], turn rate [rad/s] (left positive). A reading holds
  from its time until the next one; before the first one the robot stands still.
- `Robot1_Measurement.dat`: time [s], barcode, range [m], bearing [rad] (from the heading, left positive).
  Its header says subject where it means barcode. Robots, which move, and unknown barcodes are left out; a logged message
  counts them. Its range is the depth of a barcode along the camera's axis, computed from its height in the image: see
  `ranges_of_depths`.
- `Robot1_Groundtruth.dat`, `Landmark_Groundtruth.dat`, if the truth is known: time [s], x [m], y [m], heading
  [rad], and subject, x [m], y [m], standard deviations of both [m].

A frame is an instant at which at least one landmark was observed. The motion between two frames and its covariance come
from `integrate`, with the standard deviations of `DEFAULT_NOISE`, as the log has none. Some barcodes are misread, which the
log does not show. Of a folder with several robots pass the path of one `..._Measurement.dat`.
K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", IJRR 30(8), 2011.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE2, Array
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.format import Format
from rbpf.sensors.readers.robot_log import LogNoise, RobotLog, assemble, diagonal, require_ranges
from rbpf.sensors.readers.text import read_columns, require_seconds

DEFAULT_NOISE = LogNoise(
    std_range_m=0.06, std_bearing_rad=0.02, std_speed_mps=0.02, std_turn_rate_radps=0.04, scale_odometry=1.0
)

_LAST_ROBOT = 5
_WIDEST_RAD = 1.2  #: Largest bearing within the field of view of these robots' cameras.
_SUFFIX = "_Measurement.dat"
_log = logging.getLogger(__name__)


@final
class Mrclam(Format[LogNoise, RobotLog]):
    """Logs of one robot of the UTIAS data sets; the path may also be the robot's table of measurements."""

    kind = (
        "an MRCLAM log (a folder with Barcodes.dat and one robot's ..._Measurement.dat and ..._Odometry.dat,"
        " or the path of that ..._Measurement.dat)"
    )

    def recognises(self, path: Path) -> bool:
        if path.is_dir():
            return (path / "Barcodes.dat").is_file() or any(path.glob(f"*{_SUFFIX}"))
        return path.name.endswith(_SUFFIX)

    def read(self, path: Path, noise: LogNoise) -> RobotLog:
        noise.require_only(DEFAULT_NOISE.given(), path, "an MRCLAM log")
        noise = replace(DEFAULT_NOISE, **noise.given())
        folder, prefix = path.parent, path.name.removesuffix(_SUFFIX)
        if path.is_dir():
            robots = sorted(file.name for file in path.glob(f"*{_SUFFIX}"))
            if len(robots) != 1:
                several = f"those of {len(robots)} robots; name one, such as {path / robots[0]}" if robots else ""
                raise InputError(f"{path}: expected {self.kind}; found {several or 'none'}.")
            folder, prefix = path, robots[0].removesuffix(_SUFFIX)
        barcodes = read_columns(folder / "Barcodes.dat", ("subject", "barcode"), self.kind)
        barcodes.require(barcodes["subject"] >= 1, "subject", "1 or more")
        names = barcodes.names("barcode").tolist(), barcodes.names("subject").tolist()
        subjects = dict(zip(*names, strict=True))
        # The observations of landmarks; their times define the frames.
        file = folder / f"{prefix}{_SUFFIX}"
        table = read_columns(file, ("time", "barcode", "range", "bearing"), self.kind)
        require_ranges(table, "range", "bearing")
        landmarks = np.array([subjects.get(barcode, 0) for barcode in table.integers("barcode").tolist()])
        kept = landmarks > _LAST_ROBOT
        unknown = np.count_nonzero(landmarks == 0)
        moving = len(kept) - np.count_nonzero(kept) - unknown
        _log.info("%s: left out %d observations of robots and %d of unknown barcodes", file, moving, unknown)
        if not kept.any():
            raise InputError(f"{file}: expected observations of landmarks, found no barcode of one.")
        stamps, frame = np.unique(table.stamps_ns()[kept], return_inverse=True)
        z = table.block("range", "bearing")[kept]
        cov_z = diagonal([np.full(len(z), noise.std_range_m), np.full(len(z), noise.std_bearing_rad)])
        if np.abs(z[:, 1]).max() < _WIDEST_RAD:
            z, cov_z = ranges_of_depths(z, cov_z)
        else:
            _log.warning("%s: bearings reach further to the side than a camera's: ranges are taken as they are.", file)
        # The motion between the frames.
        table = read_columns(folder / f"{prefix}_Odometry.dat", ("time", "forward speed", "turn rate"), self.kind)
        readings_ns = table.stamps_ns()
        require_seconds(table.path, readings_ns, "odometry's rows")
        # Holding the last reading longer than any other was held would make up motion.
        late = int(stamps[-1]) - int(readings_ns[-1])
        if late > int(np.diff(readings_ns).max(initial=0)):
            ends = f"the odometry ends {late / 1e9:.3f} s before the last observation"
            raise table.error(len(readings_ns) - 1, f"{ends}, expected it to last longer")
        delta, by_noise = integrate(readings_ns, table["turn rate"], table["forward speed"], stamps)
        variance = np.square(np.array([noise.std_turn_rate_radps, noise.std_speed_mps], dtype=float))
        cov_delta = noise.odometry_variance_factor() * np.einsum("tsab,s->tab", by_noise, variance)
        name = folder.resolve().name
        return RobotLog(
            name=name if path.is_dir() else f"{name}_{prefix}",
            space=SE2,
            measurement="range_bearing",
            robot_from_sensor=SE2.identity(),
            frames=assemble(stamps, delta, cov_delta, frame, landmarks[kept], z, cov_z),
            misread=True,
            truth=_read_truth(folder / f"{prefix}_Groundtruth.dat", folder / "Landmark_Groundtruth.dat"),
        )


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


def ranges_of_depths(z: Array, cov_z: Array) -> tuple[Array, Array]:
    """Ranges and bearings (n, 2), and their covariance (n, 2, 2), from depths along a camera's axis and bearings.

    A barcode's height in a rectified image gives its depth, range × cos(bearing). On data set 6, robot 1, the log's "range"
    is the true depth to 0.042 m (standard deviation, after removing a scale of 1.025), the true range to 0.122 m.
    """
    depth, bearing = z.T
    distance = depth / np.cos(bearing)
    gain = np.zeros((len(z), 2, 2))
    gain[:, 0, 0], gain[:, 0, 1], gain[:, 1, 1] = 1.0 / np.cos(bearing), distance * np.tan(bearing), 1.0
    return np.stack([distance, bearing], axis=1), gain @ cov_z @ np.swapaxes(gain, 1, 2)


def integrate(
    readings_ns: NDArray[np.int64], turn_rate: Array, speed: Array, instants_ns: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Motion between consecutive instants from readings of speed and turn rate, and its covariance.

    A reading holds until the next one, so that the motion over a piece of length dt is exactly
    Exp(dt [turn rate, speed, 0]). Both carry white noise, whose standard deviations are therefore densities, per
    root second, and the noise of a piece is independent of that of the others,

        delta = prod_k Exp(dt_k [omega_k, v_k, 0] + sqrt(dt_k) [e_omega, e_v, 0]),
        e_omega ~ N(0, std_turn_rate^2),  e_v ~ N(0, std_speed^2).

    Its covariance is sum_k G_k diag(std_turn_rate^2, std_speed^2) G_k^T dt_k with G_k the derivative in the right
    chart. No piece has lateral noise, so that the covariance of a single piece is singular.

    Args are readings of the turn rate (n,) [rad/s] and the forward speed (n,) [m/s] at ordered times (n,), before the first
    of which the robot stands still, and strictly ordered instants (T,). Returns delta (T - 1, 3), elements of SE(2), and
    their covariances (T - 1, 2, 3, 3) per unit noise of the turn rate and of the speed, in the right chart at delta.
    """
    if len(instants_ns) == 1:
        return np.empty((0, 3)), np.empty((0, 2, 3, 3))
    within = readings_ns[(readings_ns > instants_ns[0]) & (readings_ns < instants_ns[-1])]
    edges = np.union1d(instants_ns, within)
    dt = np.diff(edges) / 1e9
    reading = np.searchsorted(readings_ns, edges[:-1], side="right") - 1
    moving = np.where(reading >= 0, dt, 0.0)
    xi = np.stack([moving * turn_rate[reading], moving * speed[reading], np.zeros_like(dt)], axis=1)
    # The cumulative product of the motions: headings are summed up, then translations.
    motion = SE2.exp(xi)
    chain = np.zeros((len(xi) + 1, 3))
    chain[1:, 0] = np.cumsum(xi[:, 0])
    chain[1:, 1:] = np.cumsum(SE2.transform(chain[:-1] * [1, 0, 0], motion[:, 1:]), axis=0)
    bounds = np.searchsorted(edges, instants_ns)
    start, end = bounds[:-1], bounds[1:]
    delta = SE2.between(chain[start], chain[end])
    # The noise of a piece is propagated through the rest of its interval.
    end_from_piece = SE2.between(chain[np.repeat(end, end - start)], chain[1:])
    gain = np.moveaxis(SE2.adjoint(end_from_piece) @ SE2.right_jacobian(xi)[:, :, :2], 2, 1)
    gain *= np.sqrt(dt)[:, None, None]
    return delta, np.add.reduceat(gain[..., :, None] * gain[..., None, :], start, axis=0)
