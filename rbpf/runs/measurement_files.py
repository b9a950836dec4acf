"""Files of a run's measurements, for comparison with a batch optimiser.

Their format is described in docs/run_folder.md.
"""

import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Self, final

import numpy as np
from numpy.typing import NDArray

from rbpf import gaussian
from rbpf.core.checkpoint import whole
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array, SE2Group, SE3Group
from rbpf.sensors.camera import LENSES, Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.readers.measurements import KINDS, Measurements, are_covariances, are_poses
from rbpf.sensors.readers.text import line_error, parse_number, quoted, read_lines

OBSERVATIONS = "observations.csv"
ODOMETRY = "observations_odometry.csv"
FRAMES = "observations_frames.csv"
KNOWN = "observations_known_points.csv"
PLAIN = "radial-tangential"  #: The lens of files that name none.

FILES = {OBSERVATIONS: "observations", ODOMETRY: "odometry", FRAMES: "frames", KNOWN: "known points"}
_TITLES = {name: f"rbpf {what} 1" for name, what in FILES.items()}
_HINT = "a file that every filter run writes into its folder"
_COVARIANCE = "a positive semi-definite covariance"
_SPACES: dict[str, SE2Group | SE3Group] = {"SE2": SE2, "SE3": SE3}
_PIXELS = {"pinhole": ["u_px", "v_px"], "stereo": ["u_left_px", "v_px", "u_right_px"]}
_KNOWN_COLUMNS = ["landmark", "x_m", "y_m", "z_m", "c00", "c10", "c11", "c20", "c21", "c22"]
_WHOLE = re.compile(r"[+-]?\d{1,19}", re.ASCII)
_INT64 = np.iinfo(np.int64)


def write_measurements(folder: Path, m: Measurements | FeatureLog | None) -> None:
    """Writes the files atomically."""
    texts = {} if m is None else _camera_texts(m) if isinstance(m, FeatureLog) else _robot_texts(m)
    with ExitStack() as together:
        for name, text in texts.items():
            together.enter_context(whole(folder / name)).write_text(text, encoding="utf-8")


def read_measurements(folder: Path) -> Measurements | FeatureLog:
    """Reads what `write_measurements` wrote; a camera's log has no truth. An InputError names the file and the line."""
    table = _Table.read(folder / OBSERVATIONS)
    kind = table.choice("measurement", (*KINDS, *_PIXELS))
    return _read_camera_log(folder, table, kind) if kind in _PIXELS else _read_robot(folder, table)


def read_feature_log(folder: Path) -> FeatureLog:
    """`read_measurements` of a camera's run; raises InputError for a robot's."""
    table = _Table.read(folder / OBSERVATIONS)
    return _read_camera_log(folder, table, table.choice("measurement", tuple(_PIXELS)))


def _robot_texts(m: Measurements) -> dict[str, str]:
    header = {
        "space": repr(m.space),
        "measurement": m.measurement,
        "pitch_sign": f"{m.pitch_sign:g}",
        "robot_from_sensor": " ".join(map(repr, m.robot_from_sensor.tolist())),
        "start": " ".join(map(repr, m.start.tolist())),
        "start_stamp_ns": str(int(m.stamps_ns[0])),
    }
    observed, moved = [m.steps, m.stamps_ns[m.steps], m.landmarks], [np.arange(1, len(m.stamps_ns)), m.stamps_ns[1:]]
    seen = _text(OBSERVATIONS, m.recording, header, _observed(_axes(m.space)), observed, m.z, m.cov_z)
    odometry = _text(ODOMETRY, m.recording, {"space": repr(m.space)}, _moves(m.space), moved, m.deltas, m.covs)
    return {OBSERVATIONS: seen, ODOMETRY: odometry}


def _camera_texts(log: FeatureLog) -> dict[str, str]:
    pair = log.camera if isinstance(log.camera, RectifiedStereo) else None
    left, kind = (log.camera, "pinhole") if isinstance(log.camera, Pinhole) else (log.camera.camera, "stereo")
    header = {"space": "SE3", "measurement": kind, "size": f"{left.width} {left.height}"}
    if left.distortion_model != PLAIN:
        header["lens"] = left.distortion_model
    header["camera"] = " ".join(repr(float(x)) for x in (left.fx, left.fy, left.cx, left.cy, *left.distortion))
    if pair is not None:
        header["baseline"] = repr(float(pair.baseline_m))
    stamps = np.array([frame.stamp_ns for frame in log.frames], dtype=np.int64)
    steps = np.repeat(np.arange(stamps.size), [frame.landmarks.size for frame in log.frames])
    names, z, cov = (np.concatenate([getattr(f, part) for f in log.frames]) for part in ("landmarks", "z", "cov_z"))
    rows = [steps, stamps[steps], names]
    texts = {
        OBSERVATIONS: _text(OBSERVATIONS, log.name, header, _observed(_PIXELS[kind]), rows, z, cov),
        FRAMES: _text(FRAMES, log.name, {}, ["step", "stamp_ns"], [np.arange(stamps.size), stamps]),
    }
    if log.known is not None:
        known = [log.known.names], log.known.positions, log.known.cov
        texts[KNOWN] = _text(KNOWN, log.name, {}, _KNOWN_COLUMNS, *known)
    return texts


def _text(
    name: str, recording: str, header: dict[str, str], columns: list[str], integers: list[np.ndarray], *numbers: Array
) -> str:
    """Writes a file: integer columns (n,); then optionally numbers (n, k) and their covariances (n, d, d)."""
    lines = [f"# {_TITLES[name]}", f"# recording: {recording}"]
    lines += [f"# {key}: {value}" for key, value in header.items()]
    lines += [f"# rows: {len(integers[0])}", ",".join(columns)]
    parts = [part if part.ndim == 2 else gaussian.pack(part) for part in numbers]
    all_columns = [*integers, *(column for part in parts for column in part.T)]
    lines += [",".join(map(repr, row)) for row in zip(*(column.tolist() for column in all_columns), strict=True)]
    return "\n".join([*lines, ""])


def _read_robot(folder: Path, seen: "_Table") -> Measurements:
    moved = _Table.read(folder / ODOMETRY)
    space = _SPACES[seen.choice("space", tuple(_SPACES))]
    for key in ("recording", "space"):
        moved.require_same(key, seen)
    integers, numbers = moved.body(_moves(space), 2)
    moved.require(integers[:, 0] == np.arange(1, len(integers) + 1), "one row per step, from step 1 in order")
    stamps = np.concatenate([[seen.whole("start_stamp_ns")], integers[:, 1]])
    moved.require(np.diff(stamps) >= 0, "stamps in order of time")
    deltas, covs = numbers[:, : space.size], gaussian.unpack(numbers[:, space.size :], space.dim)
    moved.require(are_poses(space, deltas), "an increment that begins with a quaternion of length 1")
    moved.require(are_covariances(covs), _COVARIANCE)
    integers, numbers = seen.body(_observed(_axes(space)), 3)
    steps, stamp, landmarks = integers.T
    inside = (steps >= 0) & (steps < len(stamps))
    seen.require(inside, f"a step from 0 to {len(stamps) - 1}, the last one in {ODOMETRY}")
    seen.require(stamp == stamps[steps], f"the stamp that {ODOMETRY} gives this step")
    p = space.point_dim
    cov_z = gaussian.unpack(numbers[:, p:], p)
    seen.require(are_covariances(cov_z), _COVARIANCE)
    return Measurements(
        recording=seen.text("recording"),
        space=space,
        measurement=KINDS[seen.choice("measurement", tuple(KINDS))],
        pitch_sign=float(seen.choice("pitch_sign", ("1", "-1"))),
        robot_from_sensor=_read_pose(seen, "robot_from_sensor", space),
        start=_read_pose(seen, "start", space),
        stamps_ns=stamps,
        deltas=deltas,
        covs=covs,
        steps=steps,
        landmarks=landmarks,
        z=numbers[:, :p],
        cov_z=cov_z,
    )


def _read_camera_log(folder: Path, seen: "_Table", kind: str) -> FeatureLog:
    seen.choice("space", ("SE3",))
    listed = _Table.read(folder / FRAMES)
    listed.require_same("recording", seen)
    integers, _ = listed.body(["step", "stamp_ns"], 2)
    listed.require(integers[:, 0] == np.arange(len(integers)), "one row per frame, from step 0 in order")
    stamps = np.ascontiguousarray(integers[:, 1])
    listed.require(np.diff(stamps, prepend=stamps[:1]) >= 0, "stamps in order of time")
    integers, numbers = seen.body(_observed(_PIXELS[kind]), 3)
    steps = integers[:, 0]
    seen.require((steps >= 0) & (steps < stamps.size), f"a step from 0 to {stamps.size - 1}, the last in {FRAMES}")
    seen.require(integers[:, 1] == stamps[steps], f"the stamp that {FRAMES} gives this step")
    seen.require(np.diff(steps, prepend=0) >= 0, "steps in order")
    cuts = np.searchsorted(steps, np.arange(1, stamps.size))
    camera = _read_camera(seen, kind)
    p = camera.dim
    columns = (integers[:, 2], numbers[:, :p], gaussian.unpack(numbers[:, p:], p))
    parts = zip(stamps.tolist(), *(np.split(column, cuts) for column in columns), strict=True)
    known = None
    if (folder / KNOWN).exists():
        names, numbers = _Table.read(folder / KNOWN).body(_KNOWN_COLUMNS, 1)
        known = KnownPoints(names[:, 0].copy(), numbers[:, :3].copy(), gaussian.unpack(numbers[:, 3:], 3))
    return FeatureLog(seen.text("recording"), camera, [FeatureFrame(*part) for part in parts], known)


def _read_camera(table: "_Table", kind: str) -> Pinhole | RectifiedStereo:
    width, height = table.numbers("size", 2).tolist()
    lens = table.choice("lens", tuple(LENSES)) if "lens" in table.header else PLAIN
    fx, fy, cx, cy, *distortion = table.numbers("camera", 4 + len(LENSES[lens].coefficient_names)).tolist()
    baseline = table.numbers("baseline", 1) if kind == "stereo" else None
    try:
        camera = Pinhole(int(width), int(height), fx, fy, cx, cy, tuple(distortion), lens)
        return camera if baseline is None else RectifiedStereo(camera, float(baseline[0]))
    except InputError as error:  # whose message does not name the file
        raise InputError(f"{table.path}: {error}") from None


def _read_pose(table: "_Table", key: str, space: SE2Group | SE3Group) -> Array:
    pose = table.numbers(key, space.size)
    if not are_poses(space, pose[None])[0]:
        raise table.header_error(key, f"expected {key} to begin with a quaternion of length 1")
    return pose


def _axes(space: SE2Group | SE3Group) -> list[str]:
    return [f"z{i}" for i in range(space.point_dim)]


def _observed(measured: list[str]) -> list[str]:
    return ["step", "stamp_ns", "landmark", *measured, *_triangle(len(measured))]


def _moves(space: SE2Group | SE3Group) -> list[str]:
    return ["step", "stamp_ns", *(f"d{i}" for i in range(space.size)), *_triangle(space.dim)]


def _triangle(count: int) -> list[str]:
    return [f"c{i}{j}" for i in range(count) for j in range(i + 1)]


@final
@dataclass(frozen=True)
class _Table:
    """Lines of one of the files, validated lazily; every method raises InputError for a malformed line."""

    path: Path  #: the file.
    header: dict[str, tuple[int, str]]  #: line number and text of each named value.
    columns: str  #: the line with the columns' names.
    columns_line: int  #: its number, from 1.
    rows: list[str]  #: the lines below it.

    @classmethod
    def read(cls, path: Path) -> Self:
        """Reads a file whose first line is its title."""
        lines, title = read_lines(path, _HINT), _TITLES[path.name]
        if lines[0] != f"# {title}":
            raise line_error(path, 1, f"expected '# {title}', found {quoted(lines[0])}")
        header: dict[str, tuple[int, str]] = {}
        for number, line in enumerate(lines[1:], 2):
            if not line.startswith("#"):
                return cls(path, header, line, number, lines[number:])
            key, _, value = line.removeprefix("#").partition(":")
            header[key.strip()] = (number, value.strip())
        raise line_error(path, len(lines), "expected the columns' names below, found the file's end")

    def text(self, key: str) -> str:
        return self._entry(key)[1]

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        if self.text(key) not in allowed:
            problem = f"expected {key} to be {' or '.join(allowed)}, found {quoted(self.text(key))}"
            raise self.header_error(key, problem)
        return self.text(key)

    def whole(self, key: str) -> int:
        line, text = self._entry(key)
        return self._whole_number(line, key, text)

    def numbers(self, key: str, count: int) -> Array:
        """Named numbers, (count,)."""
        line, text = self._entry(key)
        fields = text.split()
        if len(fields) != count:
            raise self.header_error(key, f"expected {count} numbers for {key}, found {len(fields)}")
        return np.array([parse_number(self.path, line, key, field) for field in fields])

    def body(self, names: Sequence[str], integers: int) -> tuple[NDArray[np.int64], Array]:
        """The first `integers` columns, which are whole numbers, and the others (n, k)."""
        if self.columns != ",".join(names):
            problem = f"expected the columns {','.join(names)}, found {quoted(self.columns)}"
            raise line_error(self.path, self.columns_line, problem)
        count = self.whole("rows")
        if count != len(self.rows):
            problem = f"expected {count} rows as the header says, found {len(self.rows)}; copy the file again"
            raise self.row_error(len(self.rows) - 1, problem)
        wholes = np.empty((count, integers), dtype=np.int64)
        numbers = np.empty((count, len(names) - integers))
        for row, text in enumerate(self.rows):
            line, fields = self.columns_line + 1 + row, text.split(",")
            if len(fields) != len(names):
                problem = f"expected {len(names)} columns ({', '.join(names)}), found {len(fields)}"
                raise self.row_error(row, problem)
            named = list(zip(names, fields, strict=True))
            wholes[row] = [self._whole_number(line, *field) for field in named[:integers]]
            numbers[row] = [parse_number(self.path, line, *field) for field in named[integers:]]
        return wholes, numbers

    def require(self, valid: NDArray[np.bool_], expected: str) -> None:
        """Raises InputError for the first row at which `valid` (n,) is False."""
        if not valid.all():
            raise self.row_error(int(np.argmin(valid)), f"expected {expected}")

    def require_same(self, key: str, other: "_Table") -> None:
        """Raises InputError: a named value differs from that in another of the run's files."""
        if self.text(key) != other.text(key):
            found = f"expected {key} {other.text(key)} as in {other.path.name}, found {quoted(self.text(key))}"
            raise self.header_error(key, f"{found}; take both files from one run")

    def header_error(self, key: str, problem: str) -> InputError:
        """Error that points at a named value."""
        return line_error(self.path, self._entry(key)[0], problem)

    def row_error(self, row: int, problem: str) -> InputError:
        """Error that points at a row, counted from 0."""
        return line_error(self.path, self.columns_line + 1 + row, problem)

    def _entry(self, key: str) -> tuple[int, str]:
        if key not in self.header:
            problem = f"expected a line '# {key}: ...' above this one, found none"
            raise line_error(self.path, self.columns_line, problem)
        return self.header[key]

    def _whole_number(self, line: int, name: str, text: str) -> int:
        if not _WHOLE.fullmatch(text) or not _INT64.min <= int(text) <= _INT64.max:
            raise line_error(self.path, line, f"expected {name} to be a whole number, found {quoted(text)}")
        return int(text)
