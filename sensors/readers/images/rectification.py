"""Two cameras side by side: pairing of their images in time, and rectification.

Images are rectified by OpenCV's `stereoRectify`. Without fisheye lenses the rectified field of view is as wide as the
images allow. For a fisheye this would shrink the centre and stretch the borders: there the focal length at the centre is
kept, and what lies outside the image is cut off. A lens of 140° on images 640 px wide, f = 262 px, keeps 101°.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Source

#: Least component of the baseline along the rows, relative to its length; below it most of the view is lost.
BESIDE = 0.7
OUTSIDE = -10.0  #: A pixel outside every image: what is mapped from there becomes black.
ALIKE_PX = 1e-2  #: Tolerance of equal intrinsics in a rectified pair: rounding errors, invisible in the image.
#: Tolerances of a rectified pair: rotation of the axes, and the baseline's relative offset from the rows.
ROTATED_RAD, ASIDE = 1e-4, 1e-2


#: For each camera, columns and rows (H, W) float32 of the original image for each rectified pixel.
Maps = list[tuple[np.ndarray, np.ndarray]]


def rectification(
    left: Pinhole, right: Pinhole, left_from_right: Array, where: str
) -> tuple[RectifiedStereo, Array, Maps]:
    """Computes the rectification of two cameras of one image size, the second at `left_from_right` (7,).

    Returns the pair, the pure rotation left_from_rectified (7,), and the maps. Raises InputError: as `rectified`.
    """
    import cv2

    shift = SE3.translation(left_from_right)
    if shift[0] < BESIDE * np.linalg.norm(shift):
        x, y, z = (f"{component:.4g}" for component in shift)
        raise InputError(
            f"{where}: the right camera is at ({x}, {y}, {z}) m from the left one, expected it to the right, "
            "along the rows; exchange the two, or correct T_BS."
        )
    right_from_left, size = SE3.inverse(left_from_right), (left.width, left.height)
    motion = SE3.rotation(right_from_left), SE3.translation(right_from_left)[:, None]
    maps: Maps
    if "equidistant" in (left.distortion_model, right.distortion_model):
        # The rotations are OpenCV's, which depend on the two poses alone; the maps use our own lens models, and point
        # outside the image where the lens sees nothing.
        fx, fy, cx, cy = np.mean([left.params[:4], right.params[:4]], axis=0).tolist()
        camera = Pinhole(*size, 0.5 * (fx + fy), 0.5 * (fx + fy), cx, cy)
        same = (*_opencv(camera), *_opencv(camera))
        turns = cv2.stereoRectify(*same, size, *motion, flags=cv2.CALIB_ZERO_DISPARITY)[:2]
        rows, columns = np.mgrid[: left.height, : left.width].astype(float)
        uv = camera.unproject(np.stack([columns, rows], axis=-1))
        rays, maps = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1), []
        for given, turn in zip((left, right), turns, strict=True):
            px = np.where(given.visible(rays @ turn)[..., None], given.project(rays @ turn), OUTSIDE)
            column, row = cv2.split(px.astype(np.float32))
            maps.append((column, row))
        rig = RectifiedStereo(camera, float(np.linalg.norm(shift)))
    else:
        both = (*_opencv(left), *_opencv(right))
        found = cv2.stereoRectify(*both, size, *motion, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
        turns, projections = found[:2], found[2:4]
        fx, fy, cx, cy = projections[0][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        maps = [
            cv2.initUndistortRectifyMap(*_opencv(given), turn, target, size, cv2.CV_32FC1)
            for given, turn, target in zip((left, right), turns, projections, strict=True)
        ]
        rig = RectifiedStereo(Pinhole(*size, fx, fy, cx, cy), -float(projections[1][0, 3]) / fx)
    return rig, SE3.from_matrix(np.column_stack([turns[0].T, np.zeros(3)])), maps


@final
@dataclass(frozen=True)
class RectifiedImages(Source):
    """Rectifies the pairs of another source."""

    source: Source
    maps: Maps

    def frames(self, start: int) -> Iterator[ImageFrame]:
        import cv2

        for frame in self.source.frames(start):
            left, right = (
                None if image is None else np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR))
                for image, maps in zip((frame.image, frame.right), self.maps, strict=True)
            )
            yield replace(frame, image=left, right=right)


def rectified(sequence: ImageSequence, right: Pinhole, left_from_right: Array, where: str, note: str) -> ImageSequence:
    """Rectifies the pairs of a sequence, and its truth; images that are already rectified are unchanged.

    The second camera is at `left_from_right` (7,); `where` names its calibration in messages, and the `note` is added if
    images are rectified. Raises InputError: the right camera is not to the right of the left one.
    """
    # They are already rectified if both have equal sizes, intrinsics and axes and no distortion, and the right one lies to
    # the right of the left one along the rows.
    left, (along, *across) = sequence.camera, SE3.translation(left_from_right)
    plain = left.lens.is_identity and right.lens.is_identity
    equal = plain and (left.width, left.height) == (right.width, right.height)
    aligned = np.linalg.norm(SE3.log(left_from_right)[:3]) <= ROTATED_RAD and np.linalg.norm(across) <= ASIDE * along
    if equal and aligned and along > 0.0 and np.abs(left.params - right.params).max() <= ALIKE_PX:
        return replace(sequence, baseline_m=float(along))
    rig, left_from_rectified, maps = rectification(left, right, left_from_right, where)
    truth = sequence.truth and replace(sequence.truth, poses=SE3.compose(sequence.truth.poses, left_from_rectified))
    source, notes = RectifiedImages(sequence.source, maps), (*sequence.notes, note)
    return replace(sequence, camera=rig.camera, truth=truth, baseline_m=rig.baseline_m, source=source, notes=notes)


def _opencv(camera: Pinhole) -> tuple[Any, Any]:
    fx, fy, cx, cy = camera.params[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.array(camera.distortion)


def pair_stamps(
    left_ns: np.ndarray, right_ns: np.ndarray, tolerance_s: float, where: str
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Pairs of images that are mutual nearest neighbours in time, within the tolerance, in order of time.

    Returns rows (P,) of the left camera's ordered times (T,) and (P,) of the right one's (U,), and a sentence about each
    camera with images left out.
    """
    nearest, gap_ns = nearest_in_time(left_ns, right_ns)
    back, _ = nearest_in_time(right_ns, left_ns)
    # The first of equal times stands for all: mutual neighbours are compared by time, not by row.
    mutual = left_ns[back[nearest]] == left_ns
    left = np.flatnonzero(mutual & (gap_ns <= round(tolerance_s * 1e9)))
    left = left[np.unique(nearest[left], return_index=True)[1]]
    right = nearest[left]
    if not left.size:
        least = f"the nearest two are {gap_ns.min() * 1e-9:.6f} s apart"
        action = "put both on one clock, or give a larger tolerance"
        raise InputError(f"{where}: no left and right image were taken within {tolerance_s:g} s, {least}; {action}.")
    notes = [
        f"{where}: {stamps.size - left.size} of {stamps.size} {side} images have no partner within {tolerance_s:g} s "
        "and are left out."
        for side, stamps in (("left", left_ns), ("right", right_ns))
        if stamps.size > left.size
    ]
    return left, right, tuple(notes)


def nearest_in_time(stamps_ns: np.ndarray, among_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row (T,) of the nearest time (the earlier in a tie), and its distance (T,) in ns."""
    after = np.clip(np.searchsorted(among_ns, stamps_ns), 0, among_ns.size - 1)
    before = np.maximum(after - 1, 0)
    gap_before, gap_after = np.abs(stamps_ns - among_ns[before]), np.abs(stamps_ns - among_ns[after])
    return np.where(gap_before <= gap_after, before, after), np.minimum(gap_before, gap_after)
