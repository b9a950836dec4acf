"""A recording of feature observations: pixels of named landmarks, landmarks known in advance, and ground truth."""

from dataclasses import dataclass, field
from numbers import Integral

import numpy as np

from rbpf.arrays import RowByRow
from rbpf.core.checkpoint import covariances, elements, integers, numbers, require, stamps
from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.sensors.camera import Pinhole, RectifiedStereo

_FRAME = {"landmarks": integers("K", distinct=True), "z": numbers("K", "p"), "cov_z": covariances("K", "p", "p")}
_KNOWN = {"names": integers("M", distinct=True), "positions": numbers("M", 3), "cov": covariances("M", 3, 3)}


@dataclass(frozen=True)
class FeatureFrame(RowByRow):
    """One image: which landmarks were observed, at which pixels. A `FeatureLog` and the systems validate it."""

    stamp_ns: int  #: time of the image, integer nanoseconds.
    landmarks: np.ndarray  #: (K,) int64 names, each once.
    z: np.ndarray  #: (K, p) pixels: (u, v), or (u_left, v, u_right) of a stereo pair.
    cov_z: np.ndarray  #: (K, p, p) their covariance, px².

    @property
    def cov(self) -> np.ndarray:
        """(K, p, p) `cov_z`, under the name that all kinds of features share."""
        return self.cov_z

    def check(self, dim: int, where: str = "") -> None:
        """Raises InputError: shapes do not fit so many numbers per pixel, a number is not finite, a name occurs twice."""
        require(where or f"the frame at {self.stamp_ns} ns", vars(self), _FRAME, p=dim)


@dataclass(frozen=True)
class KnownPoints:
    """Landmarks known in advance, such as the corners of a calibration target.

    Raises InputError: a shape or a type is wrong, a number is not finite, a name occurs twice, or a cov is not a
    covariance.
    """

    names: np.ndarray  #: (M,) int64, each once.
    positions: np.ndarray  #: (M, 3) in the world, m.
    cov: np.ndarray  #: (M, 3, 3) their covariance, m².

    def __post_init__(self) -> None:
        require("the known points", vars(self), _KNOWN)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a recording: poses in SE(2) or SE(3), and landmarks.

    Raises InputError: a shape or a type is wrong, a number is not finite, the stamps are out of order, or a
    quaternion is not of unit length.
    """

    stamps_ns: np.ndarray  #: (T,) int64 times of the poses, in order.
    poses: np.ndarray  #: (T, E) world_from_body at these times, of the camera or the robot; unit quaternions.
    #: name of a landmark to its (D,) position in the world, m.
    landmarks: dict[int, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        what, planar = "the ground truth", self.poses.shape[1:] == (3,)
        require(what, vars(self), {"stamps_ns": stamps("T"), "poses": elements(SE2 if planar else SE3, "T")})
        places = {f"landmark {name}": position for name, position in self.landmarks.items()}
        require(what, places, dict.fromkeys(places, numbers("" if planar else 3)))


@dataclass(frozen=True)
class FeatureLog:
    """A camera recording of landmark observations.

    Raises InputError: there is no frame, or one is out of order, names a landmark twice, has a shape or a type that
    does not fit the camera, a number that is not finite, or a cov_z that is no covariance.
    """

    name: str  #: short name of the recording.
    camera: Pinhole | RectifiedStereo  #: that took the images.
    frames: list[FeatureFrame]  #: the images in order of time; equal stamps are allowed.
    known: KnownPoints | None = None  #: landmarks known in advance, or None.
    truth: Truth | None = None  #: ground truth, or None.

    def __post_init__(self) -> None:
        if not self.frames:
            raise InputError(f"{self.name} holds no frame, expected at least one image")
        for index, frame in enumerate(self.frames):
            where = f"frame {index} of {self.name}"
            stamp_ns: object = frame.stamp_ns
            if not isinstance(stamp_ns, Integral):
                raise InputError(f"{where}: stamp_ns must be a whole number of nanoseconds, got {stamp_ns!r}")
            frame.check(self.camera.dim, where)
            before = self.frames[max(index - 1, 0)].stamp_ns
            if frame.stamp_ns < before:
                order = f"at {frame.stamp_ns} ns is before the frame it follows ({before} ns)"
                raise InputError(f"{where} {order}: sort the frames by time")

    @property
    def stamps_ns(self) -> np.ndarray:
        """(T,) int64 times of the frames."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)
