"""What a camera saw, feature by feature: pixels of named landmarks, the landmarks known beforehand, and the truth."""

from dataclasses import dataclass, field
from numbers import Integral

import numpy as np

from rbpf import gaussian
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole, RectifiedStereo

UNIT = 1e-6  #: How far a quaternion's length may be from 1: six decimals in a file leave it there.


@dataclass(frozen=True)
class FeatureFrame:
    """One image: which landmarks were seen, and where. It is checked by the `FeatureLog`, which knows its index."""

    stamp_ns: int  #: time of the image, integer nanoseconds.
    landmarks: np.ndarray  #: (K,) int64 names, each once.
    z: np.ndarray  #: (K, p) pixels: (u, v), or (u_left, v, u_right) of a stereo pair.
    cov_z: np.ndarray  #: (K, p, p) their covariance, px².

    @property
    def cov(self) -> np.ndarray:
        """(K, p, p), as features of any kind have it."""
        return self.cov_z

    def __len__(self) -> int:
        return len(self.landmarks)

    def take(self, rows: np.ndarray | slice) -> "FeatureFrame":
        """Some of its features, by number or by mask."""
        return FeatureFrame(self.stamp_ns, self.landmarks[rows], self.z[rows], self.cov_z[rows])


@dataclass(frozen=True)
class KnownPoints:
    """Landmarks known beforehand, such as the corners of a calibration target.

    Raises InputError: a shape or a type is another one, a number is not finite, a name comes twice, or a cov is no
    covariance.
    """

    names: np.ndarray  #: (M,) int64, each once.
    positions: np.ndarray  #: (M, 3) in the world, m.
    cov: np.ndarray  #: (M, 3, 3) their covariance, m².

    def __post_init__(self) -> None:
        where = "the known points"
        _check_names(where, "names", "M", self.names)
        count = len(self.names)
        _check_numbers(where, "positions", self.positions, (count, 3))
        _check_covariances(where, "cov", self.cov, (count, 3, 3))


@dataclass(frozen=True)
class Truth:
    """Ground truth of a recording: poses in SE(2) or SE(3), and landmarks.

    Raises InputError: a shape or a type is another one, a number is not finite, the stamps are out of order, or a
    quaternion is not of unit length.
    """

    stamps_ns: np.ndarray  #: (T,) int64 times of the poses, in order.
    poses: np.ndarray  #: (T, E) world_from_body at these times, of the camera or the robot; unit quaternions.
    #: name of a landmark to its (D,) position in the world, m.
    landmarks: dict[int, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = "the ground truth"
        _check_whole(where, "stamps_ns", "T", self.stamps_ns)
        planar = self.poses.shape[1:] == (3,)
        _check_numbers(where, "poses", self.poses, (len(self.stamps_ns), 3 if planar else 7))
        if (late := np.flatnonzero(np.diff(self.stamps_ns) < 0)).size:
            raise InputError(f"{where}: stamp {late[0] + 1} is before the one it follows, sort the poses by time")
        length = np.ones(len(self.poses)) if planar else np.linalg.norm(self.poses[:, :4], axis=1)
        if (wrong := np.flatnonzero(np.abs(length - 1.0) > UNIT)).size:
            found = f"pose {wrong[0]} has a quaternion of length {length[wrong[0]]:.9g}"
            raise InputError(f"{where}: {found}, expected [qx, qy, qz, qw, x, y, z] with a unit quaternion")
        for name, position in self.landmarks.items():
            _check_numbers(where, f"landmark {name}", position, position.shape if planar else (3,))


@dataclass(frozen=True)
class FeatureLog:
    """A recording of a camera that sees landmarks.

    Raises InputError: there is no frame, or one is out of order, names a landmark twice, has a shape or a type that
    does not fit the camera, a number that is not finite, or a cov_z that is no covariance.
    """

    name: str  #: short name of the recording.
    camera: Pinhole | RectifiedStereo  #: that took the images.
    frames: list[FeatureFrame]  #: the images in order of time; equal stamps, between which no time passes, are allowed.
    known: KnownPoints | None = None  #: landmarks known beforehand, None where there are none.
    truth: Truth | None = None  #: ground truth, None where the log has none.

    def __post_init__(self) -> None:
        if not self.frames:
            raise InputError(f"{self.name} holds no frame, expected at least one image")
        for index, frame in enumerate(self.frames):
            where = f"frame {index} of {self.name}"
            stamp_ns: object = frame.stamp_ns
            if not isinstance(stamp_ns, Integral):
                raise InputError(f"{where}: stamp_ns must be a whole number of nanoseconds, got {stamp_ns!r}")
            _check_names(where, "landmarks", "K", frame.landmarks)
            shape = (len(frame.landmarks), self.camera.dim)
            _check_numbers(where, "z", frame.z, shape)
            _check_covariances(where, "cov_z", frame.cov_z, (*shape, self.camera.dim))
            before = self.frames[max(index - 1, 0)].stamp_ns
            if frame.stamp_ns < before:
                order = f"at {frame.stamp_ns} ns is before the frame it follows ({before} ns)"
                raise InputError(f"{where} {order}: sort the frames by time")

    @property
    def stamps_ns(self) -> np.ndarray:
        """(T,) int64 times of the frames."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)


def _check_whole(where: str, what: str, letter: str, values: np.ndarray) -> None:
    """Refuses all but a vector of whole numbers."""
    if not (isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype == np.int64):
        raise InputError(f"{where}: {what} must be ({letter},) int64, got {_described(values)}")


def _check_names(where: str, what: str, letter: str, names: np.ndarray) -> None:
    """Refuses all but a vector of names, each once."""
    _check_whole(where, what, letter, names)
    unique, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{where}: landmark {unique[np.argmax(counts > 1)]} comes twice, keep one of the two")


def _check_numbers(where: str, what: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuses all but finite numbers of this shape."""
    if not (isinstance(values, np.ndarray) and values.shape == shape and values.dtype == np.float64):
        raise InputError(f"{where}: {what} must be {shape} float64, got {_described(values)}")
    if not (finite := np.isfinite(values)).all():
        place = tuple(int(i) for i in np.argwhere(~finite)[0])
        raise InputError(f"{where}: {what} must be finite, entry {place} is {values[place]}")


def _check_covariances(where: str, what: str, cov: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuses all but symmetric positive semi-definite matrices of this shape."""
    _check_numbers(where, what, cov, shape)
    try:
        gaussian.psd_factor(cov)
    except InputError as error:
        raise InputError(f"{where}: {what} is no covariance: {error}") from error


def _described(values: object) -> str:
    if isinstance(values, np.ndarray):
        return f"{values.shape} {values.dtype}"
    return f"a {type(values).__name__}"
