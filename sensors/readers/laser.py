"""Recordings of a laser scanner on a robot: CARMEN logs, plain or gzip-compressed, and ROS bags.

**CARMEN** logs are lines of words, of which these are read (`[…]` repeats as often as the number before it):

    FLASER n [range] x y theta odom_x odom_y odom_theta time host logged
    ROBOTLASER1 type start field_of_view resolution max_range accuracy mode n [range] m [remission]
        laser_x laser_y laser_theta robot_x robot_y robot_theta 5 more numbers, time host logged
    RAWLASER1 type start field_of_view resolution max_range accuracy mode n [range] m [remission] time host logged
    ODOM x y theta speed turn_rate acceleration time host logged
    PARAM name value

in metres, radians and Unix seconds; RLASER, ROBOTLASER2, RAWLASER2 are a second scanner. The odometry is that in the scans'
own lines, else of the ODOM lines, interpolated. FLASER does not state its beams: they are 1° apart (180 and 181 readings,
the first at -90°), 0.5° (360 and 361) or 0.25° (400 and 401, the first at -50°), as of SICK's scanners; any other number
spreads over 180°. The scanner's mounting pose is the difference of a line's two poses if all lines agree on it (they do not
in a log with a corrected path), else from the parameters `robot_frontlaser_offset`, `…_side_offset` and `…_angular_offset`.

**ROS bags** hold sensor_msgs LaserScan, the odometry as nav_msgs Odometry or as the transform from a frame called `odom` in
`/tf`, and the scanner's mounting pose in `/tf` or `/tf_static`, upside down or not.

A range of zero or less, or NaN, is invalid; one of the maximum range or more is no return. The maximum range is the log's
(`robot_front_laser_max` up to 80 m); without one 80 m, or 8.18 m if no range exceeds the 8.19 m that SICK's scanners reach
in millimetres. Without odometry the log has None for it. Scans up to a second out of order, from programs that write
concurrently, are left out with a warning; a clock set back by more is refused. Scans that rotate against the odometry give
a warning; jumps of the odometry are kept.
"""

import logging
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array
from rbpf.ranges import Positive, Ranged
from rbpf.sensors.laser import LaserLog, Scanner
from rbpf.sensors.readers.format import Format, recognised
from rbpf.sensors.readers.images.bag import SUFFIXES, Bag, numbers_of, opened
from rbpf.sensors.readers.part import WHOLE, Part
from rbpf.sensors.readers.text import line_error, numbered_lines, parse_number, parse_time, quoted

#: CARMEN messages that hold scans; by default the first that a log has is read.
SCANNERS = ("FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER", "ROBOTLASER2", "RAWLASER2")
SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

LATE_NS = 1_000_000_000  #: Largest delay of a scan written after one of a later time.

_FAR_M, _MILLIMETRES_M = 80.0, (8.18, 8.2)
#: Test for a mirrored scanner: most rotations used, their least angle [rad], largest scan distance, σ of matching ends [m].
_TURNS, _TURNED, _NEAR_M, _WALL_M = 50, 0.2, 2.0, 0.2
_HEAD = ("type", "start angle", "field of view", "angular resolution", "maximum range", "accuracy", "remission mode")
_POSES = ("x", "y", "theta", "odometry's x", "odometry's y", "odometry's theta")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LaserOptions(Ranged):
    """Options for what a recording may not state. Raises InputError: the greatest range is not positive."""

    scanner: str | None = None  #: name of the message (CARMEN) or topic (ROS) of its scans; None takes the first.
    #: the scanner is mounted upside down, or its readings run clockwise: the angles are mirrored.
    upside_down: bool = False
    max_range_m: Positive | None = None  #: beyond it there is no return; None takes the log's.
    part: Part = WHOLE  #: which of its scans.


@dataclass(frozen=True)
class ScansOfFile:
    """All scans of one scanner, S of them, at least one, in the order of the file; each has odometry, or none has."""

    angles: Array  #: (B,) of the beams, ascending or descending.
    places: np.ndarray  #: (S,) location of each in the file, for messages.
    stamps_ns: np.ndarray  #: (S,) int64.
    ranges: Array  #: (S, B).
    odometry: Array | None = None  #: (S, E) world_from_robot.
    min_range_m: float = 0.0
    max_range_m: float | None = None  #: None if the log has none.
    robot_from_sensor: Array = field(default_factory=SE2.identity)  #: (E,).
    upside_down: bool = False

    def take(self, rows: np.ndarray) -> Self:
        """The scans of these rows."""
        kept = {name: getattr(self, name)[rows] for name in ("places", "stamps_ns", "ranges")}
        return replace(self, **kept, odometry=None if self.odometry is None else self.odometry[rows])


def read_laser_log(path: str | Path, options: LaserOptions | None = None) -> LaserLog:
    """Read a recording of a scanner, a CARMEN log or a ROS bag, as this module's docstring describes.

    Raises InputError: the path does not exist, a line is malformed (it is named), there are no scans or none of the
    requested scanner, all are outside the part, or the clock runs backwards.
    """
    options = options or LaserOptions()
    path, found = recognised(path, LASERS, "; or ".join(one.kind for one in LASERS))
    read = found.read(path, options)
    # Scans in order of time; those slightly out of order are left out.
    late_ns = np.maximum.accumulate(read.stamps_ns)[:-1] - read.stamps_ns[1:]
    if (far := np.flatnonzero(late_ns > LATE_NS)).size:
        problem = f"the time runs backwards by {late_ns[far[0]] * 1e-9:.3f} s, expected scans in order of time"
        raise InputError(f"{path}, {read.places[far[0] + 1]}: {problem}.")
    if left := int((late_ns >= 0).sum()):
        _log.warning("%s: left out %d scans whose time is not after that of the scan before.", path, left)
        read = read.take(np.flatnonzero(np.append(True, late_ns < 0)))
    read = read.take(options.part.rows((read.stamps_ns - read.stamps_ns[0]) * 1e-9, f"{path}: no scan is left"))
    # Ranges: too near (NaN), a hit, or no return (inf).
    ranges = read.ranges
    longest = ranges[np.isfinite(ranges)].max(initial=0.0)
    millimetres = _MILLIMETRES_M[0] <= longest < _MILLIMETRES_M[1]
    max_range_m = options.max_range_m or read.max_range_m or (_MILLIMETRES_M[0] if millimetres else _FAR_M)
    valid = (ranges > 0.0) & (ranges >= read.min_range_m)
    ranges = np.where(valid, np.where(ranges >= max_range_m, np.inf, ranges), np.nan)
    # Angles counterclockwise, ascending.
    angles = -read.angles if options.upside_down != read.upside_down else read.angles
    if angles[0] > angles[-1]:
        angles, ranges = angles[::-1].copy(), ranges[:, ::-1].copy()
    try:
        scanner = Scanner(angles, read.min_range_m, max_range_m, read.robot_from_sensor)
    except InputError as error:
        raise InputError(f"{path}: {error}; give the greatest range that counts.") from None
    odometry = None if read.odometry is None else SE2.normalise(read.odometry)
    whole = path.resolve()
    name = whole.name if whole.is_dir() else whole.name.removesuffix(".gz").rpartition(".")[0] or whole.name
    log = LaserLog(name, scanner, read.stamps_ns, ranges, odometry)
    _warn_if_mirrored(path, log)
    return log


def _chosen(path: Path, what: str, names: Sequence[str], given: str | None = None) -> str:
    """The given name, or the first, with a warning if there are several."""
    if len(names) > 1:
        _log.warning("%s: %s of %s, of %s.", path, what, given or names[0], ", ".join(names))
    return given or names[0]


def _warn_if_mirrored(path: Path, log: LaserLog) -> None:
    """Warns if the scans before and after rotations match each other only with mirrored angles."""
    if log.odometry is None:
        return  # without rotations the mirrored scans are equally consistent
    angles, mount = log.scanner.angles, log.scanner.robot_from_sensor
    every, gains, first = -(-angles.size // 200), list[float](), 0
    towards = np.stack([np.cos(angles), np.sin(angles)], axis=1)[::every]
    for last in range(1, len(log.odometry)):
        moved = SE2.between(log.odometry[first], log.odometry[last])
        if np.hypot(moved[1], moved[2]) > _NEAR_M or abs(moved[0]) > 1.0:
            first = last
        elif abs(moved[0]) >= _TURNED:
            pair, fits = [(r, np.isfinite(r)) for r in log.ranges[[first, last], ::every]], list[float]()
            for side in (1.0, -1.0):
                points = (r[there, None] * towards[there] * [1.0, side] for r, there in pair)
                before, after = (SE2.transform(mount, each) for each in points)
                apart = np.linalg.norm(before - SE2.transform(moved, after)[:, None], axis=-1)
                away = apart.min(axis=1, initial=np.inf)
                fits.append(float(np.exp(-0.5 * (away / _WALL_M) ** 2).sum() / len(towards)))
            gains.append(fits[1] - fits[0])
            first = last
        if len(gains) == _TURNS:
            break
    if len(gains) >= _TURNS // 5 and np.mean(gains) > 5.0 * np.std(gains) / np.sqrt(len(gains)):
        _log.warning(
            "%s: the scans rotate against the odometry, %d of %d rotations fit better mirrored: is the scanner upside down "
            "(--upside-down mirrors it), or the odometry's heading reversed?", path, (np.array(gains) > 0.0).sum(), len(gains),
        )  # fmt: skip


def _interpolated(path: Path, scans: ScansOfFile, stamps_ns: list[int], poses: list[Array]) -> ScansOfFile:
    """Interpolates the odometry at the scans' times; scans outside its time span are left out."""
    if not poses:
        return scans
    times, first = np.unique(np.array(stamps_ns, dtype=np.int64), return_index=True)
    known = np.stack(poses)[first]
    inside = np.flatnonzero((times[0] <= scans.stamps_ns) & (scans.stamps_ns <= times[-1]))
    if not inside.size:
        raise InputError(f"{path}: the odometry and the scans have no time in common, expected one clock.")
    if left := scans.stamps_ns.size - inside.size:
        _log.warning("%s: left out %d scans before the odometry begins or after it ends.", path, left)
    scans = scans.take(inside)
    after = np.searchsorted(times, scans.stamps_ns).clip(min=min(1, times.size - 1))
    before = (after - 1).clip(min=0)
    fraction = (scans.stamps_ns - times[before]) / np.maximum(times[after] - times[before], 1)
    return replace(scans, odometry=SE2.interpolate(known[before], known[after], fraction))


@final
class Carmen(Format[LaserOptions, ScansOfFile]):
    """CARMEN logs."""

    kind = f"a CARMEN log (a text file with lines {', '.join(SCANNERS[:2])}, …, which may be packed by gzip)"

    def recognises(self, path: Path) -> bool:
        return not path.is_dir()

    def read(self, path: Path, options: LaserOptions) -> ScansOfFile:
        lines = [(number, line.split()) for number, line in numbered_lines(path, self.kind)]
        there = dict.fromkeys(words[0] for _, words in lines)
        names = [name for name in SCANNERS if name in there]
        if options.scanner is not None and options.scanner not in names:
            raise InputError(f"{path}: expected scans called {options.scanner}, found {', '.join(names) or 'none'}.")
        if not names:
            beginnings = ", ".join(quoted(name) for name in list(there)[:5]) or "none"
            raise InputError(f"{path}: expected {self.kind}; found lines of {beginnings}.")
        name = _chosen(path, "the scans are those", names, options.scanner)
        rear = name == "RLASER" or name.endswith("2")
        side = "rear" if rear else "front"
        offsets = (f"robot_{side}laser_angular_offset", f"robot_{side}laser_offset", f"robot_{side}laser_side_offset")
        wanted, params = {*offsets, f"robot_{side}_laser_max"}, dict[str, float]()
        stamps, poses = list[int](), list[Array]()
        found = list[tuple[int, "_Line"]]()
        for number, words in lines:
            if words[0] == "PARAM" and len(words) > 2 and words[1] in wanted:
                params[words[1]] = parse_number(path, number, words[1], words[2])
            elif words[0] == "ODOM":
                if len(words) < 8:
                    problem = f"expected x, y, theta, 3 more numbers and a time, found {len(words)} words"
                    raise line_error(path, number, problem)
                x, y, theta = _numbers(path, number, _POSES[:3], words[1:4])
                stamps.append(parse_time(path, number, words[7]))
                poses.append(np.array([theta, x, y]))
            elif words[0] == name:
                found.append((number, _Line.parse(path, number, words)))
        line, first = found[0]
        for number, one in found:
            if one.beams != first.beams:
                raise line_error(path, number, f"expected {first.beams} as in line {line}, found {one.beams}")
        count = first.ranges.size
        if first.head:
            start, view, step = first.head[1:4]
            step = step or view / max(count - 1, 1)
            if problem := _not_beams(start, step, count):
                raise line_error(path, line, problem)
            angles = start + step * np.arange(count)
        else:
            usual = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5, 400: 0.25, 401: 0.25}
            step = usual.get(count, 180.0 / max(count - 1, 1))
            angles = np.radians((-50.0 if count in (400, 401) else -90.0) + step * np.arange(count))
        scans = ScansOfFile(
            np.asarray(angles, dtype=float),
            np.array([f"line {number}" for number, _ in found]),
            np.array([one.stamp_ns for _, one in found], dtype=np.int64),
            np.stack([one.ranges for _, one in found]),
        )
        mounts = np.empty((0, 3))
        if first.poses is None:
            scans = _interpolated(path, scans, stamps, poses)
        else:
            laser, odometry = np.stack([one.poses for _, one in found if one.poses is not None], axis=1)
            scans, mounts = replace(scans, odometry=odometry), SE2.between(odometry, laser)
        # The mounting pose: from the lines if all agree, else from the parameters, by default zero.
        stated = np.array([params.get(key, 0.0) for key in offsets])
        same = len(mounts) > 0 and float(np.abs(SE2.local(mounts[0], mounts)).max()) < 1e-3
        if same and (np.abs(mounts[0]).max() > 1e-3 or not stated.any()):
            mount = np.asarray(mounts[0])
        elif not rear:
            mount = np.asarray(SE2.normalise(stated))
        else:
            _log.warning("%s: no mounting pose of %s; assumed at the robot's origin, facing backwards.", path, name)
            mount = np.array([np.pi, 0.0, 0.0])
        farthest = first.head[4] if first.head else min(params.get(f"robot_{side}_laser_max", 0.0), _FAR_M)
        return replace(scans, max_range_m=farthest if farthest > 0.0 else None, robot_from_sensor=mount)


class _Line(NamedTuple):
    """A line with a scan."""

    head: tuple[float, ...]
    ranges: Array
    stamp_ns: int
    poses: Array | None  #: (2, E) of the scanner and of the robot.

    @classmethod
    def parse(cls, path: Path, number: int, words: list[str]) -> "_Line":
        name, at = words[0], 1
        old = name in ("FLASER", "RLASER")

        def take(names: tuple[str, ...]) -> Array:
            nonlocal at
            at += len(names)
            return _numbers(path, number, names, words[at - len(names) : at])

        def take_list(what: str) -> Array:
            """Readings after their count; at least a time must follow in the line."""
            nonlocal at
            count = float(take((f"the number of {what}",))[0])
            if not (count == int(count) and 0 <= count < len(words) - at):
                problem = f"expected {count:g} {what} and what follows them, found {len(words) - at} words"
                raise line_error(path, number, problem)
            values = []  # may be nan or inf
            for word in words[at : at + int(count)]:
                try:
                    values.append(float(word))
                except ValueError:
                    raise line_error(path, number, f"expected {what} to be numbers, found {quoted(word)}") from None
            at += len(values)
            return np.array(values)

        head = () if old else tuple(take(_HEAD).tolist())
        ranges = take_list("readings")
        if not ranges.size:
            raise line_error(path, number, "expected readings, found none")
        if not old:
            take_list("remissions")
        poses = None
        if not name.startswith("RAW"):
            poses = np.roll(take(_POSES).reshape(2, 3), 1, axis=1)
            at += 0 if old else 5
        # The time, usually followed by a host name and the time at which the line was written.
        if not 1 <= len(words) - at <= 3:
            problem = f"expected a time, a host and a time after {at} words, found {len(words) - at} words"
            raise line_error(path, number, f"{problem}; is the number of readings right?")
        return cls(head, ranges, parse_time(path, number, words[at]), poses)

    @property
    def beams(self) -> str:
        """A description of the beams, equal for equal beams."""
        named = [f"{name} {value:g}" for name, value in zip(_HEAD[1:5], self.head[1:5], strict=False)]
        return ", ".join([f"{self.ranges.size} readings", *named])


def _not_beams(start: float, step: float, count: int) -> str:
    """The error of `count` beams from `start` in increments of `step`; empty if they are valid."""
    sound = np.isfinite([start, step]).all() and (step or count == 1)
    if count and sound and max(abs(start), abs(step) * (count - 1)) <= 2.0 * np.pi + 1e-3:
        return ""
    return f"expected beams in radians, within a turn, found {count} from {start:g} on, each {step:g} further"


def _numbers(path: Path, line: int, names: Sequence[str], words: list[str]) -> Array:
    """Words as finite numbers. Raises InputError: there are fewer words than names."""
    if len(words) < len(names):
        raise line_error(path, line, f"expected {names[len(words)]}, found the end of the line")
    return np.array([parse_number(path, line, *pair) for pair in zip(names, words, strict=True)])


@final
class LaserBag(Format[LaserOptions, ScansOfFile]):
    """ROS bags."""

    kind = "a ROS bag (.bag, .mcap, .db3, or a folder with metadata.yaml) with sensor_msgs/LaserScan"

    def recognises(self, path: Path) -> bool:
        return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()

    def read(self, path: Path, options: LaserOptions) -> ScansOfFile:
        with opened(path) as bag:
            topics = bag.of_type(SCAN)
            if not topics or options.scanner not in (None, *topics):
                wanted, held = options.scanner or "of LaserScan", ", ".join(topics) or "none"
                raise InputError(f"{path}: expected a topic {wanted}, found {held} of LaserScan.")
            topic = _chosen(path, "the scans are those", topics, options.scanner)
            where, frame, damaged = f"{path}, {topic}", "", 0
            beams: tuple[int, float, float, float, float] | None = None
            places, stamps_ns, ranges = list[str](), list[int](), list[Array]()
            for number, raw in enumerate(bag.messages(topic)):
                try:
                    message = bag.message(raw)
                except InputError:
                    damaged += 1
                    continue
                reach = float(message.range_min), float(message.range_max)
                found = len(message.ranges), float(message.angle_min), float(message.angle_increment), *reach
                beams, frame = beams or found, frame or message.header.frame_id
                if found != beams:
                    raise InputError(f"{where}, scan {number}: expected beams as in the scans before, found others.")
                places.append(f"scan {number}")
                stamps_ns.append(raw.stamp_ns)
                ranges.append(np.array(message.ranges, dtype=float))
            if beams is None:
                raise InputError(f"{where}: no scan can be read.")
            if damaged:
                _log.warning("%s: left out %d damaged scans.", where, damaged)
            count, start, step, nearest, farthest = beams
            if problem := _not_beams(start, step, count):
                raise InputError(f"{where}: {problem}.")
            transforms = _Transforms(bag)
            stamps, poses, base = transforms.odometry(frame)
            mount = transforms.mount(base, frame)
        if mount is None:
            _log.warning("%s: no mounting pose of the scanner; assumed at the robot's origin.", where)
            mount = SE3.identity()
        scans = ScansOfFile(
            np.asarray(start + step * np.arange(count), dtype=float),
            np.array(places),
            np.array(stamps_ns, dtype=np.int64),
            np.stack(ranges),
            min_range_m=nearest if np.isfinite(nearest) and nearest > 0.0 else 0.0,
            max_range_m=farthest if np.isfinite(farthest) and farthest > 0.0 else None,
            robot_from_sensor=_planar(mount),
            upside_down=bool(SE3.rotation(mount)[2, 2] < 0.0),
        )
        return _interpolated(path, scans, stamps, poses)


def _planar(pose: Array) -> Array:
    """Projects a pose (7,) in space to SE2 (E,)."""
    yaw, _, _ = SE3.ypr(pose)
    return np.array([float(yaw), *SE3.translation(pose)[:2]])


class _Transforms:
    """The odometry and the tf tree of a bag; poses are parent_from_child."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._parents: dict[str, str] = {}
        self._poses: dict[str, list[tuple[int, Array]]] = defaultdict(list)
        for topic in bag.of_type(TRANSFORMS, "tf/msg/tfMessage"):
            for raw in bag.messages(topic, headed=False):
                try:
                    message = bag.message(raw._replace(type=TRANSFORMS))
                except InputError:
                    continue
                for one in message.transforms:
                    child, stamp = one.child_frame_id.strip("/"), one.header.stamp
                    pose = _pose(one.transform)
                    if pose is not None:
                        self._parents[child] = one.header.frame_id.strip("/")
                        self._poses[child].append((stamp.sec * 10**9 + stamp.nanosec, pose))

    def odometry(self, scanner: str) -> tuple[list[int], list[Array], str]:
        """Times, poses (E,), and the robot's frame: from a topic, or from the transforms; empty if there are none."""
        topics = self._bag.of_type(ODOMETRY)
        if topics:
            given = "/odom" if "/odom" in topics else None
            topic = _chosen(self._bag.path, "the odometry is that", topics, given)
            stamps, poses, base = list[int](), list[Array](), ""
            for raw in self._bag.messages(topic):
                message = self._bag.message(raw)
                pose = _pose(message.pose.pose)
                base = base or message.child_frame_id.strip("/")
                if pose is not None:
                    stamps.append(raw.stamp_ns)
                    poses.append(_planar(pose))
            return stamps, poses, base
        chain = self._chain(scanner)
        for child in chain:
            if self._parents.get(child, "").endswith("odom"):
                return [stamp for stamp, _ in self._poses[child]], [_planar(p) for _, p in self._poses[child]], child
        return [], [], chain[-1] if len(chain) > 1 else ""

    def mount(self, base: str, scanner: str) -> Array | None:
        """robot_from_sensor (7,), None if the transforms do not contain it."""
        pose = SE3.identity()
        for child in self._chain(scanner):
            if child == base:
                return pose
            if child in self._poses:
                pose = SE3.compose(self._poses[child][0][1], pose)
        return None

    def _chain(self, frame: str) -> list[str]:
        """A frame, its parent, and so on."""
        chain = [frame.strip("/")]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain


def _pose(message: Any) -> Array | None:
    """(7,), None if it is not a valid pose."""
    pose = numbers_of(message)
    if not (np.isfinite(pose).all() and abs(float(np.linalg.norm(pose[:4])) - 1.0) < 1e-2):
        return None
    return np.asarray(SE3.normalise(pose))


#: Formats in order; the first that recognises a recording reads it.
LASERS: tuple[Format[LaserOptions, ScansOfFile], ...] = (LaserBag(), Carmen())
