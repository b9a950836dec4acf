"""Pinhole camera with radial-tangential or equidistant (fisheye) distortion, and the rectified stereo pair.

Order of the coefficients and pixel convention are OpenCV's: the centre of the top-left pixel is (0, 0). The distortion
is that of `rbpf.sensors.camera.distortion`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, final

import numpy as np

from rbpf.arrays import Bool, Float
from rbpf.errors import InputError
from rbpf.ranges import Count, Positive, check_ranges
from rbpf.sensors.camera.distortion import Equidistant, RadialTangential, inverse

Lens = RadialTangential | Equidistant

#: Lens classes by the name of their distortion model; `kind` is its number in the compiled functions.
LENSES: dict[str, type[Lens]] = {"radial-tangential": RadialTangential, "equidistant": Equidistant}


@final
@dataclass(frozen=True)
class Pinhole:
    """Pinhole camera with distortion (OpenCV's models and pixel convention).

    Raises InputError: a number is out of its range or not finite, the distortion model is unknown, or needs another
    number of coefficients.
    """

    width: Count  #: of the image, px.
    height: Count  #: of the image, px.
    fx: Positive  #: focal length along the rows, px.
    fy: Positive  #: focal length along the columns, px.
    cx: float  #: column of the principal point, px.
    cy: float  #: row of the principal point, px.
    #: k1, k2, p1, p2, k3; of an equidistant lens k1, k2, k3, k4.
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    #: radial-tangential, or equidistant: a fisheye lens, used up to 75° from the axis.
    distortion_model: str = "radial-tangential"
    dim = 2

    def __post_init__(self) -> None:
        if self.distortion_model not in LENSES:
            known = " or ".join(LENSES)
            raise InputError(f"the camera's distortion_model must be {known}, got {self.distortion_model!r}")
        names = LENSES[self.distortion_model].coefficient_names
        if np.shape(self.distortion) != (len(names),):
            left_out = " (k3 = 0 if there are four)" if len(names) == 5 else ""
            expected = f"the {len(names)} numbers {', '.join(names)}{left_out}"
            raise InputError(f"the camera's distortion must be {expected}, got {self.distortion!r}")
        # A list from a file would make the camera unhashable.
        object.__setattr__(self, "distortion", tuple(self.distortion))
        check_ranges(self, "the camera's ")

    @classmethod
    def from_params(cls, width: int, height: int, params: Float[np.ndarray, "10"]) -> Self:
        """The camera with these `params`. Raises InputError: as the constructor, or no lens has this kind."""
        models = {lens.kind: name for name, lens in LENSES.items()}
        model = models.get(float(params[9]), f"of kind {params[9]:g}")
        count = len(LENSES[model].coefficient_names) if model in LENSES else 0
        fx, fy, cx, cy, *distortion = (float(number) for number in params)
        return cls(width, height, fx, fy, cx, cy, tuple(distortion[:count]), model)

    def tuned(self, by: Float[np.ndarray, "4"]) -> Self:
        """The camera with focal lengths fx exp(by₀), fy exp(by₁), and by₂, by₃ added to k1 and k2."""
        (x, y), (k1, k2, *rest) = np.exp(by[:2]).tolist(), self.distortion
        lens = (k1 + float(by[2]), k2 + float(by[3]), *rest)
        return replace(self, fx=self.fx * x, fy=self.fy * y, distortion=lens)

    def resized(self, width: int, height: int) -> Self:
        """The camera for resized images: the centre of the first pixel stays at (0, 0)."""
        x, y = width / self.width, height / self.height
        centre = x * (self.cx + 0.5) - 0.5, y * (self.cy + 0.5) - 0.5
        return replace(self, width=width, height=height, fx=x * self.fx, fy=y * self.fy, cx=centre[0], cy=centre[1])

    def turned(self, quarters: int) -> Self:
        """The camera for images rotated clockwise by `quarters` times 90°."""
        camera = self
        for _ in range(quarters % 4):
            c, lens = camera, camera.distortion
            if len(lens) == 5:  # the tangential coefficients rotate with the axes; the radial ones stay
                lens = (lens[0], lens[1], lens[3], -lens[2], lens[4])
            camera = replace(
                c, width=c.height, height=c.width, fx=c.fy, fy=c.fx, cx=c.height - 1 - c.cy, cy=c.cx, distortion=lens
            )
        return camera

    @cached_property
    def params(self) -> Float[np.ndarray, "10"]:
        """(10,) fx, fy, cx, cy, distortion (four numbers and 0, or five), kind of lens; for the compiled twin."""
        coefficients = np.pad(np.array(self.distortion, dtype=float), (0, 5 - len(self.distortion)))
        return np.array([self.fx, self.fy, self.cx, self.cy, *coefficients, self.lens.kind], dtype=np.float64)

    @cached_property
    def lens(self) -> Lens:
        """The distortion, in normalised coordinates."""
        return LENSES[self.distortion_model](self.distortion)  # type: ignore[arg-type]  # length checked by __post_init__

    def project(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels (…, 2) of points (…, 3) in the camera's frame.

        Only the direction matters: (u, v, 1) and a point at infinity work. Nothing is checked, see `visible`; a point with
        z = 0 gets pixels that are not finite.
        """
        with np.errstate(all="ignore"):
            return self.params[:2] * self.lens.distort(_normalise(point)) + self.params[2:4]

    def jacobian(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 3"]:
        """∂px/∂point (…, 2, 3) at points (…, 3) in the camera's frame."""
        point = np.asarray(point, float)
        with np.errstate(all="ignore"):
            uv = _normalise(point)
            by_uv = self.params[:2, None] * self.lens.jacobian(uv) / point[..., 2, None, None]
            return np.concatenate([by_uv, -by_uv @ uv[..., None]], axis=-1)

    def by_tuning(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 4"]:
        """∂px/∂by (…, 2, 4) of `tuned`, at by = 0, of points (…, 3) in the camera's frame."""
        with np.errstate(all="ignore"):
            uv = _normalise(point)
            bent = self.params[:2] * self.lens.distort(uv)
            along = self.params[:2, None] * uv[..., None] * self.lens.by_coefficients(uv)[..., None, :]
            return np.concatenate([bent[..., None] * np.eye(2), along], axis=-1)

    def unproject(self, px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Normalised coordinates (u, v) (…, 2) of pixels (…, 2): the point lies in the direction (u, v, 1).

        Newton's method on the distortion. NaN if no direction within the one-to-one range of the distortion projects to the
        pixel.
        """
        with np.errstate(all="ignore"):
            target = (np.asarray(px, float) - self.params[2:4]) / self.params[:2]
            uv = self.lens.undistort(target.reshape(-1, 2))
        return uv.reshape(target.shape)

    def unproject_jacobian(self, px: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2 2"]:
        """∂(u, v)/∂px (…, 2, 2) at pixels (…, 2); NaN where `unproject` is."""
        return inverse(self.lens.jacobian(self.unproject(px))) / self.params[:2]

    def field_of_view_mask(self, margin_px: float) -> Bool[np.ndarray, "H W"] | None:
        """Pixels (H, W) inside the image circle of a fisheye lens by a margin; None if the circle fills the image.

        Radial-tangential lenses have no circle: there `unproject` gives NaN for the few pixels without a direction.
        """
        if np.isinf(self.lens.image_radius):
            return None
        rows, columns = np.ogrid[: self.height, : self.width]
        away = np.hypot((columns - self.cx) / self.fx, (rows - self.cy) / self.fy)
        within = away < self.lens.image_radius - margin_px / min(self.fx, self.fy)
        return None if within.all() else within

    def inside(self, px: Float[np.ndarray, "*batch 2"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): pixels (…, 2) are in the image, at least `margin_px` from its border.

        The image reaches half a pixel beyond the centres of its outermost pixels.
        """
        px = np.asarray(px, float)
        past = np.array([self.width, self.height]) - 0.5 - margin_px
        within = (px >= margin_px - 0.5) & (px <= past)
        return within[..., 0] & within[..., 1]

    def visible(self, point: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): points (…, 3) are in front of the camera, in the distortion's one-to-one range, and in the image."""
        with np.errstate(all="ignore"):
            seen = self.lens.is_invertible(_normalise(point)) & self.inside(self.project(point), margin_px)
        return np.logical_and(seen, np.asarray(point)[..., 2] > 0.0)


@final
@dataclass(frozen=True)
class RectifiedStereo:
    """Two equal undistorted pinholes side by side; the left one is the reference.

    Raises InputError: the camera is distorted, or the baseline is not positive.
    """

    camera: Pinhole  #: each of the two.
    baseline_m: Positive  #: distance of the right one from the left one, along the rows.
    dim = 3

    def __post_init__(self) -> None:
        check_ranges(self, "the stereo pair's ")
        if not self.camera.lens.is_identity:
            bent = f"{self.camera.distortion_model} distortion {self.camera.distortion}"
            found = f"the camera of a rectified stereo pair has {bent}"
            raise InputError(f"{found}: rectify the images and give the camera of the rectified ones")

    @cached_property
    def intrinsics(self) -> Float[np.ndarray, "5"]:
        """(5,) fx, fy, cx, cy and fx · baseline."""
        return np.append(self.camera.params[:4], self.camera.fx * self.baseline_m)

    def project(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Pixels (u_left, v, u_right) (…, 3) of points (…, 3) in the left camera's frame; nothing is checked."""
        right = self.camera.project(self._from_right(point))[..., :1]
        return np.concatenate([self.camera.project(point), right], axis=-1)

    def jacobian(self, point: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
        """∂px/∂point (…, 3, 3) at points (…, 3) in the left camera's frame."""
        right = self.camera.jacobian(self._from_right(point))[..., :1, :]
        return np.concatenate([self.camera.jacobian(point), right], axis=-2)

    def triangulate(self, z: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points (…, 3) in the left camera's frame seen at (u_left, v, u_right) (…, 3); NaN without disparity."""
        z = np.asarray(z, float)
        disparity = np.where(z[..., 0] > z[..., 2], z[..., 0] - z[..., 2], np.nan)[..., None]
        uv = self.camera.unproject(z[..., :2])
        ray = np.concatenate([uv, np.ones_like(disparity)], axis=-1)
        return self.camera.fx * self.baseline_m / disparity * ray

    def inside(self, px: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): (u_left, v, u_right) (…, 3) are in both images, at least `margin_px` from their borders."""
        px = np.asarray(px, float)
        return self.camera.inside(px[..., :2], margin_px) & self.camera.inside(px[..., [2, 1]], margin_px)

    def visible(self, point: Float[np.ndarray, "*batch 3"], margin_px: float = 0.0) -> Bool[np.ndarray, "*batch"]:
        """Mask (…): points (…, 3) are visible in both images."""
        right = self._from_right(point)
        return self.camera.visible(point, margin_px) & self.camera.visible(right, margin_px)

    def _from_right(self, point: np.ndarray) -> np.ndarray:
        """Points in the right camera's frame."""
        return np.asarray(point, float) - np.array([self.baseline_m, 0.0, 0.0])


def _normalise(point: np.ndarray) -> np.ndarray:
    """(x/z, y/z) (…, 2) of points (…, 3)."""
    point = np.asarray(point, float)
    return point[..., :2] / point[..., 2:]
