"""Recordings of a laser scanner on a robot: CARMEN logs, plain or packed by gzip, and ROS bags.

**CARMEN** logs are lines of words, of which these are read (`[…]` repeats as often as the number before says):

    FLASER n [range] x y theta odom_x odom_y odom_theta time host logged
    ROBOTLASER1 type start field_of_view resolution max_range accuracy mode n [range] m [remission]
        laser_x laser_y laser_theta robot_x robot_y robot_theta 5 more numbers, time host logged
    RAWLASER1 type start field_of_view resolution max_range accuracy mode n [range] m [remission] time host logged
    ODOM x y theta speed turn_rate acceleration time host logged
    PARAM name value

in metres, radians and Unix seconds; RLASER, ROBOTLASER2, RAWLASER2 are a second scanner. The odometry is that of the scans'
own lines, else of the lines ODOM, interpolated. FLASER says nothing of its beams: they are 1° apart (180 and 181 readings,
the first at -90°), 0.5° (360 and 361) or 0.25° (400 and 401, the first at -50°), as of SICK's scanners, and any other number
spreads over 180°. Where the scanner sits on the robot is the difference of a line's two poses where all lines agree on it (in
a log whose path was corrected they do not), else what the parameters `robot_frontlaser_offset`, `…_side_offset` and
`…_angular_offset` say.

**ROS bags** hold sensor_msgs LaserScan, the odometry as nav_msgs Odometry or as the transform from a frame called `odom` in
`/tf`, and where the scanner sits in `/tf` or `/tf_static`, upside down or not.

A range of zero or less, or one that is not a number, is not valid; one of the greatest range or more is no return. The
greatest range is what the log says (`robot_front_laser_max` up to 80 m); where it says nothing 80 m, or 8.18 m where no range
is beyond the 8.19 m that SICK's scanners reach in millimetres. Without odometry the log has None for it. Scans whose time is
not after that of all before them, by up to a second, come of programs that write at once; they are left out, which is said.
A clock that is set back by more is refused. Scans that turn against the odometry are said; odometry that jumps is kept.
"""

import logging
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3, Array
from rbpf.ranges import Positive, Ranged
from rbpf.sensors.laser import LaserLog, Scanner
from rbpf.sensors.readers.images.bag import SUFFIXES, Bag, opened
from rbpf.sensors.readers.part import WHOLE, Part
from rbpf.sensors.readers.text import line_error, parse_number, parse_time, quoted, read_lines

SCANNERS = ("FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER", "ROBOTLASER2", "RAWLASER2")
"""Messages of a CARMEN log that hold scans; the first that a log has is read where none is named."""
SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

LATE_NS = 1_000_000_000
"""A scan may be written so much after one of a later time."""

_FAR_M, _MILLIMETRES_M = 80.0, (8.18, 8.2)
_TURNS, _TURNED, _NEAR_M, _WALL_M = 50, 0.2, 2.0, 0.2
"""For a mirrored scanner so many turns [rad] are looked at, so far apart; two scans see one wall so near to each other."""
_HEAD = ("type", "start angle", "field of view", "angular resolution", "maximum range", "accuracy", "remission mode")
_POSES = ("x", "y", "theta", "odometry's x", "odometry's y", "odometry's theta")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LaserOptions(Ranged):
    """What a recording may leave open.

    Raises:
        InputError: the greatest range is not positive.
    """

    scanner: str | None = None  #: name of the message (CARMEN) or topic (ROS) of its scans; None takes the first.
    #: the scanner is mounted upside down, or its readings run clockwise: the angles are mirrored.
    upside_down: bool = False
    max_range_m: Positive | None = None  #: what is farther gives no return; None takes what the log says.
    part: Part = WHOLE  #: which of its scans.


class ScanOfFile(NamedTuple):
    """One scan as it stands in a file."""

    place: str  #: where, for messages.
    stamp_ns: int
    ranges: Array  #: (B,)
    odometry: Array | None  #: (E,) world_from_robot.


@dataclass
class ScansOfFile:
    """All scans of one scanner, in the order of the file."""

    angles: Array  #: (B,) of the beams, from one side to the other.
    min_range_m: float
    max_range_m: float | None  #: None where the log does not say.
    robot_from_sensor: Array = field(default_factory=SE2.identity)  #: (E,).
    upside_down: bool = False
    scans: list[ScanOfFile] = field(default_factory=list)


class LaserFormat(ABC):
    """A format of recordings of a scanner; `LASERS` lists all of them."""

    kind: str
    """What it is and which files make it, for messages."""

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether a file or folder is meant to be of this format."""

    @abstractmethod
    def read(self, path: Path, options: LaserOptions) -> ScansOfFile:
        """At least one scan, each with odometry or none with it.

        Raises:
            InputError: as `read_laser_log`.
        """


def read_laser_log(path: str | Path, options: LaserOptions | None = None) -> LaserLog:
    """Read a recording of a scanner, a CARMEN log or a ROS bag, which the head of this module describes.

    Raises:
        InputError: nothing is there, a line is not as described (it is named), there are no scans or none of the scanner
            that is asked for, all are outside of the part, or the clock runs backwards.
    """
    path, options = Path(path), options or LaserOptions()
    try:
        path.stat()
    except (OSError, ValueError):
        raise InputError(f"{path}: no such file or folder; expected {_kinds()}.") from None
    found = next((one for one in LASERS if one.recognises(path)), None)
    if found is None:
        raise InputError(f"{path}: found a folder, expected {_kinds()}.")
    read = found.read(path, options)
    scans = _in_order(path, read.scans)
    stamps_ns = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    rows = options.part.rows((stamps_ns - stamps_ns[0]) * 1e-9, f"{path}: no scan is left")
    # What a range means: too near, a wall, nothing.
    ranges = np.stack([scan.ranges for scan in scans])[rows]
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
    odometry = None
    poses = [scan.odometry for scan in scans if scan.odometry is not None]
    if poses:
        odometry = SE2.normalise(np.stack(poses))[rows]
    whole = path.resolve()
    name = whole.name if whole.is_dir() else whole.name.removesuffix(".gz").rpartition(".")[0] or whole.name
    log = LaserLog(name, scanner, stamps_ns[rows], ranges, odometry)
    _tell_mirrored(path, log)
    return log


def _kinds() -> str:
    return "; or ".join(one.kind for one in LASERS)


def _in_order(path: Path, scans: list[ScanOfFile]) -> list[ScanOfFile]:
    """Scans of ascending times; those that come a little late are left out."""
    kept = scans[:1]
    for scan in scans[1:]:
        late_ns = kept[-1].stamp_ns - scan.stamp_ns
        if late_ns > LATE_NS:
            problem = f"the time runs backwards by {late_ns * 1e-9:.3f} s, expected scans in order of time"
            raise InputError(f"{path}, {scan.place}: {problem}.")
        if late_ns < 0:
            kept.append(scan)
    if left := len(scans) - len(kept):
        _log.warning("%s: left out %d scans whose time is not after that of the scan before.", path, left)
    return kept


def _tell_mirrored(path: Path, log: LaserLog) -> None:
    """Says so where the scans before and after turns lie on each other with their angles mirrored, and not as they are."""
    if log.odometry is None:
        return  # what has no turns of its own is as consistent in a mirror
    every, gains, first = -(-log.scanner.angles.size // 200), list[float](), 0
    towards = np.stack([np.cos(log.scanner.angles), np.sin(log.scanner.angles)], axis=1)[::every]
    for last in range(1, len(log.odometry)):
        moved = SE2.between(log.odometry[first], log.odometry[last])
        if np.hypot(moved[1], moved[2]) > _NEAR_M or abs(moved[0]) > 1.0:
            first = last
        elif abs(moved[0]) >= _TURNED:
            pair, fits = [(r, np.isfinite(r)) for r in log.ranges[[first, last], ::every]], list[float]()
            for side in (1.0, -1.0):
                before, after = (
                    SE2.transform(log.scanner.robot_from_sensor, r[there, None] * towards[there] * [1.0, side])
                    for r, there in pair
                )
                away = np.linalg.norm(before - SE2.transform(moved, after)[:, None], axis=-1).min(
                    axis=1, initial=np.inf
                )
                fits.append(float(np.exp(-0.5 * (away / _WALL_M) ** 2).sum() / len(towards)))
            gains.append(fits[1] - fits[0])
            first = last
        if len(gains) == _TURNS:
            break
    if len(gains) >= _TURNS // 5 and np.mean(gains) > 5.0 * np.std(gains) / np.sqrt(len(gains)):
        _log.warning(
            "%s: the scans turn against the odometry, %d of %d turns fit better in a mirror: is the scanner upside down "
            "(--upside-down mirrors it), or the odometry's heading reversed?", path, (np.array(gains) > 0.0).sum(), len(gains),
        )  # fmt: skip


def _interpolated(path: Path, scans: list[ScanOfFile], stamps_ns: list[int], poses: list[Array]) -> list[ScanOfFile]:
    """Scans with odometry of other times than theirs; those before it begins and after it ends are left out."""
    if not poses:
        return scans
    times, first = np.unique(np.array(stamps_ns, dtype=np.int64), return_index=True)
    known = np.stack(poses)[first]
    wanted = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    inside = np.flatnonzero((times[0] <= wanted) & (wanted <= times[-1]))
    if not inside.size:
        raise InputError(f"{path}: the odometry and the scans have no time in common, expected one clock.")
    if left := len(scans) - inside.size:
        _log.warning("%s: left out %d scans before the odometry begins or after it ends.", path, left)
    after = np.searchsorted(times, wanted[inside]).clip(min=min(1, times.size - 1))
    before = (after - 1).clip(min=0)
    fraction = (wanted[inside] - times[before]) / np.maximum(times[after] - times[before], 1)
    at = SE2.interpolate(known[before], known[after], fraction)
    return [scans[row]._replace(odometry=pose) for row, pose in zip(inside.tolist(), at, strict=True)]


@final
class Carmen(LaserFormat):
    """CARMEN logs."""

    kind = f"a CARMEN log (a text file with lines {', '.join(SCANNERS[:2])}, …, which may be packed by gzip)"

    def recognises(self, path: Path) -> bool:
        return not path.is_dir()

    def read(self, path: Path, options: LaserOptions) -> ScansOfFile:
        lines = [(number, line.split()) for number, line in enumerate(read_lines(path, self.kind), 1)]
        lines = [(number, words) for number, words in lines if words and not words[0].startswith("#")]
        there = dict.fromkeys(words[0] for _, words in lines)
        names = [name for name in SCANNERS if name in there]
        if options.scanner is not None and options.scanner not in names:
            raise InputError(f"{path}: expected scans called {options.scanner}, found {', '.join(names) or 'none'}.")
        if not names:
            beginnings = ", ".join(quoted(name) for name in list(there)[:5]) or "none"
            raise InputError(f"{path}: expected {self.kind}; found lines of {beginnings}.")
        name = options.scanner or names[0]
        if len(names) > 1:
            _log.warning("%s: the scans are those of %s, of %s.", path, name, ", ".join(names))
        rear = name == "RLASER" or name.endswith("2")
        side = "rear" if rear else "front"
        offsets = (f"robot_{side}laser_angular_offset", f"robot_{side}laser_offset", f"robot_{side}laser_side_offset")
        wanted, params = {*offsets, f"robot_{side}_laser_max"}, dict[str, float]()
        stamps, poses = list[int](), list[Array]()
        found, mounts = list[tuple[int, "_Line"]](), list[Array]()
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
        (line, first), scans = found[0], list[ScanOfFile]()
        for number, one in found:
            if one.beams != first.beams:
                raise line_error(path, number, f"expected {first.beams} as in line {line}, found {one.beams}")
            scans.append(ScanOfFile(f"line {number}", one.stamp_ns, one.ranges, one.odometry))
            if one.odometry is not None and one.laser is not None:
                mounts.append(SE2.between(one.odometry, one.laser))
        if scans[0].odometry is None:
            scans = _interpolated(path, scans, stamps, poses)
        mount = _mount(path, name, mounts, np.array([params.get(key, 0.0) for key in offsets]), rear)
        farthest = first.head[4] if first.head else min(params.get(f"robot_{side}_laser_max", 0.0), _FAR_M)
        return ScansOfFile(first.angles(path, line), 0.0, farthest if farthest > 0.0 else None, mount, scans=scans)


class _Line(NamedTuple):
    """A line with a scan."""

    head: tuple[float, ...]
    ranges: Array
    stamp_ns: int
    laser: Array | None
    odometry: Array | None

    @classmethod
    def parse(cls, path: Path, number: int, words: list[str]) -> "_Line":
        name, at = words[0], 1
        old = name in ("FLASER", "RLASER")

        def take(names: tuple[str, ...]) -> Array:
            nonlocal at
            at += len(names)
            return _numbers(path, number, names, words[at - len(names) : at])

        def take_list(what: str) -> Array:
            """Readings after their count; the line must have more words, at least a time."""
            nonlocal at
            count = float(take((f"the number of {what}",))[0])
            if not (count == int(count) and 0 <= count < len(words) - at):
                problem = f"expected {count:g} {what} and what follows them, found {len(words) - at} words"
                raise line_error(path, number, problem)
            values = words[at : at + int(count)]
            at += int(count)
            return _ranges(path, number, what, values)

        head = () if old else tuple(take(_HEAD).tolist())
        ranges = take_list("readings")
        if not ranges.size:
            raise line_error(path, number, "expected readings, found none")
        if not old:
            take_list("remissions")
        laser, odometry = None, None
        if not name.startswith("RAW"):
            pose = take(_POSES)
            laser, odometry = pose[[2, 0, 1]], pose[[5, 3, 4]]
            at += 0 if old else 5
        # The time, and then mostly the name of a computer and the time at which the line was written.
        if not 1 <= len(words) - at <= 3:
            problem = f"expected a time, a host and a time after {at} words, found {len(words) - at} words"
            raise line_error(path, number, f"{problem}; is the number of readings right?")
        return cls(head, ranges, parse_time(path, number, words[at]), laser, odometry)

    @property
    def beams(self) -> str:
        """In words, which differ where they do."""
        told = [f"{name} {value:g}" for name, value in zip(_HEAD[1:5], self.head[1:5], strict=False)]
        return ", ".join([f"{self.ranges.size} readings", *told])

    def angles(self, path: Path, number: int) -> Array:
        """(B,) of the beams."""
        count = self.ranges.size
        if not self.head:
            usual = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5, 400: 0.25, 401: 0.25}
            step = usual.get(count, 180.0 / max(count - 1, 1))
            start = -50.0 if count in (400, 401) else -90.0
            return np.radians(start + step * np.arange(count))
        start, view, step = self.head[1:4]
        step = step or view / max(count - 1, 1)
        if problem := _not_beams(start, step, count):
            raise line_error(path, number, problem)
        return np.asarray(start + step * np.arange(count), dtype=float)


def _not_beams(start: float, step: float, count: int) -> str:
    """What is wrong with so many beams, the first at an angle and each a step further; empty where nothing is."""
    sound = np.isfinite([start, step]).all() and (step or count == 1)
    if count and sound and max(abs(start), abs(step) * (count - 1)) <= 2.0 * np.pi + 1e-3:
        return ""
    return f"expected beams in radians, within a turn, found {count} from {start:g} on, each {step:g} further"


def _numbers(path: Path, line: int, names: Iterable[str], words: list[str]) -> Array:
    """Words as finite numbers; a line that ends before the last name is refused."""
    names = tuple(names)
    if len(words) < len(names):
        raise line_error(path, line, f"expected {names[len(words)]}, found the end of the line")
    return np.array([parse_number(path, line, *pair) for pair in zip(names, words, strict=True)])


def _ranges(path: Path, line: int, what: str, words: list[str]) -> Array:
    """Words as numbers, which may be nan or inf."""
    values = np.empty(len(words))
    for k, word in enumerate(words):
        try:
            values[k] = float(word)
        except ValueError:
            raise line_error(path, line, f"expected {what} to be numbers, found {quoted(word)}") from None
    return values


def _mount(path: Path, name: str, mounts: list[Array], told: Array, rear: bool) -> Array:
    """robot_from_sensor (E,), from those that lines imply and the one that parameters tell, zero where they do not."""
    between = np.array(mounts).reshape(-1, 3)
    same = len(between) > 0 and float(np.abs(SE2.local(between[0], between)).max()) < 1e-3
    if same and (np.abs(between[0]).max() > 1e-3 or not told.any()):
        return np.asarray(between[0])
    if not rear:
        return np.asarray(SE2.normalise(told))
    _log.warning("%s: nothing says where %s sits; taken as in the robot's middle, looking backwards.", path, name)
    return np.array([np.pi, 0.0, 0.0])


@final
class LaserBag(LaserFormat):
    """ROS bags."""

    kind = "a ROS bag (.bag, .mcap, .db3, or a folder with metadata.yaml) with sensor_msgs/LaserScan"

    def recognises(self, path: Path) -> bool:
        return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()

    def read(self, path: Path, options: LaserOptions) -> ScansOfFile:
        with opened(path) as bag:
            topics = bag.of_type(SCAN)
            if not topics or options.scanner not in (None, *topics):
                found = f"found {', '.join(topics)}" if topics else "found none"
                raise InputError(f"{path}: expected a topic {options.scanner or 'of LaserScan'}, {found} of LaserScan.")
            topic = options.scanner or topics[0]
            if len(topics) > 1:
                _log.warning("%s: the scans are those of %s, of %s.", path, topic, ", ".join(topics))
            where, first, scans, damaged = f"{path}, {topic}", None, list[ScanOfFile](), 0
            for number, raw in enumerate(bag.messages(topic)):
                try:
                    message = bag.message(raw)
                except InputError:
                    damaged += 1
                    continue
                first = first or message
                if _beams(message) != _beams(first):
                    raise InputError(f"{where}, scan {number}: expected beams as in the scans before, found others.")
                scans.append(ScanOfFile(f"scan {number}", raw.stamp_ns, np.array(message.ranges, dtype=float), None))
            if first is None:
                raise InputError(f"{where}: no scan can be read.")
            if damaged:
                _log.warning("%s: left out %d damaged scans.", where, damaged)
            count, start, step, nearest, farthest = _beams(first)
            if problem := _not_beams(start, step, count):
                raise InputError(f"{where}: {problem}.")
            transforms = _Transforms(bag)
            stamps, poses, base = transforms.odometry(first.header.frame_id)
            mount = transforms.mount(base, first.header.frame_id)
        turned, upside_down = SE2.identity(), False
        if mount is None:
            _log.warning("%s: nothing says where the scanner sits; taken as in the robot's middle.", where)
        else:
            turned, upside_down = _planar(mount), bool(SE3.rotation(mount)[2, 2] < 0.0)
        return ScansOfFile(
            np.asarray(start + step * np.arange(count), dtype=float),
            nearest if np.isfinite(nearest) and nearest > 0.0 else 0.0,
            farthest if np.isfinite(farthest) and farthest > 0.0 else None,
            turned,
            upside_down,
            _interpolated(path, scans, stamps, poses),
        )


def _beams(message: Any) -> tuple[int, float, float, float, float]:
    start, step = float(message.angle_min), float(message.angle_increment)
    return len(message.ranges), start, step, float(message.range_min), float(message.range_max)


def _planar(pose: Array) -> Array:
    """(E,) of SE2 from a pose (7,) in space."""
    yaw, _, _ = SE3.ypr(pose)
    return np.array([float(yaw), *SE3.translation(pose)[:2]])


class _Transforms:
    """The odometry and the tree of transforms of a bag; poses are parent_from_child."""

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
                    child, stamp = _name(one.child_frame_id), one.header.stamp
                    pose = _pose(one.transform.translation, one.transform.rotation)
                    if pose is not None:
                        self._parents[child] = _name(one.header.frame_id)
                        self._poses[child].append((stamp.sec * 10**9 + stamp.nanosec, pose))

    def odometry(self, scanner: str) -> tuple[list[int], list[Array], str]:
        """Times, poses (E,), and the frame of the robot: of a topic, or of the transforms; none where there is none."""
        topics = self._bag.of_type(ODOMETRY)
        if topics:
            topic = "/odom" if "/odom" in topics else topics[0]
            if len(topics) > 1:
                _log.warning("%s: the odometry is that of %s, of %s.", self._bag.path, topic, ", ".join(topics))
            stamps, poses, base = list[int](), list[Array](), ""
            for raw in self._bag.messages(topic):
                message = self._bag.message(raw)
                pose = _pose(message.pose.pose.position, message.pose.pose.orientation)
                base = base or _name(message.child_frame_id)
                if pose is not None:
                    stamps.append(raw.stamp_ns)
                    poses.append(_planar(pose))
            return stamps, poses, base
        chain = self._chain(_name(scanner))
        for child in chain:
            if self._parents.get(child, "").endswith("odom"):
                return [stamp for stamp, _ in self._poses[child]], [_planar(p) for _, p in self._poses[child]], child
        return [], [], chain[-1] if len(chain) > 1 else ""

    def mount(self, base: str, scanner: str) -> Array | None:
        """robot_from_sensor (7,), None where the transforms do not say."""
        pose = SE3.identity()
        for child in self._chain(_name(scanner)):
            if child == base:
                return pose
            if child in self._poses:
                pose = SE3.compose(self._poses[child][0][1], pose)
        return None

    def _chain(self, frame: str) -> list[str]:
        """A frame, its parent, and so on."""
        chain = [frame]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain


def _name(frame: str) -> str:
    return frame.strip("/")


def _pose(place: Any, turn: Any) -> Array | None:
    """(7,), None where it is none."""
    pose = np.array([turn.x, turn.y, turn.z, turn.w, place.x, place.y, place.z], dtype=float)
    length = float(np.linalg.norm(pose[:4]))
    if not (np.isfinite(pose).all() and abs(length - 1.0) < 1e-2):
        return None
    return np.asarray(SE3.normalise(pose))


LASERS: tuple[LaserFormat, ...] = (LaserBag(), Carmen())
"""The first that recognises a recording reads it."""
