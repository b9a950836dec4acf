"""The map of a finished run as a place to be found again in: known points, and what they look like.

Its file, `known_map.npz`, holds only plain arrays: version, camera (9,), or (10,) with the kind of a fisheye lens,
image_size (2,), alignment, names (K,), positions (K, 3), cov (K, 3, 3), windows (K, S, S) uint8,
first_px (K, 2), first_pose (K, 7), views (V, 7).
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np

from rbpf.core.checkpoint import load_arrays, save_arrays
from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.distortion import RadialTangential
from rbpf.sensors.feature_log import KnownPoints
from rbpf.systems.mono.appearance import SOURCE_HALF_PX

Alignment = Literal["none", "rigid", "similarity"]
NAME = "known_map.npz"
VERSION = 1
LEAST = 8
"""Points that a map must hold for a camera to be found in it."""
MOST_BYTES = 1 << 30
FOCAL_FRACTION = 0.02
"""How far the focal lengths of two cameras may differ for one to recognise what the other has seen."""

_ALIGNMENTS: dict[str, Alignment] = {"none": "none", "rigid": "rigid", "similarity": "similarity"}
_SIDE = 2 * SOURCE_HALF_PX + 1


@dataclass(frozen=True)
class KnownMap:
    """K points of a finished run, in its world.

    Attributes:
        camera: that saw them.
        alignment: what the world has in common with the ground truth's: "none" where it is the same one, "rigid" up to
            a motion, "similarity" up to a motion and a scale.
        names: (K,) int64.
        positions: (K, 3);  cov: (K, 3, 3) of them, within + between particles.
        windows: (K, S, S) uint8 around the first sightings.
        first_px: (K, 2) where those were.
        first_pose: (K, 7) world_from_camera then.
        views: (V, 7) world_from_camera of the run, far from each other.
    """

    camera: Pinhole
    alignment: Alignment
    names: np.ndarray
    positions: np.ndarray
    cov: np.ndarray
    windows: np.ndarray
    first_px: np.ndarray
    first_pose: np.ndarray
    views: np.ndarray

    @property
    def points(self) -> KnownPoints:
        """The points under the numbers of their rows, which are their names in a run that is localised."""
        return KnownPoints(np.arange(self.names.size), self.positions, self.cov)

    @property
    def size_m(self) -> float:
        """Half the diagonal of the box around all points and views."""
        places = np.concatenate([self.positions, self.views[:, 4:]])
        return 0.5 * float(np.linalg.norm(np.ptp(places, axis=0)))

    def require_camera(self, camera: Pinhole, what: str) -> None:
        """Refuses another camera than the map's.

        Raises:
            InputError: sizes, focal lengths or kinds of lens differ.
        """
        mine = self.camera
        if mine.distortion_model != camera.distortion_model:
            raise InputError(
                f"the map was made through a lens with {mine.distortion_model} distortion, {what} has "
                f"{camera.distortion_model} distortion: correct its calibration, or map with it"
            )
        same = (mine.width, mine.height) == (camera.width, camera.height)
        ratio = np.array([camera.fx / mine.fx, camera.fy / mine.fy])
        if not same or np.abs(ratio - 1.0).max() > FOCAL_FRACTION:
            raise InputError(
                f"the map was made with images of {mine.width}x{mine.height} px, focal length {mine.fx:.0f} px; "
                f"{what} has {camera.width}x{camera.height} px and {camera.fx:.0f} px: scale its images, or map with it"
            )


def write_known_map(path: Path, found: KnownMap) -> None:
    """Writes the file, whole or not at all."""
    arrays = {
        item.name: getattr(found, item.name)
        for item in fields(KnownMap)
        if item.name not in ("camera", "alignment")
    }
    camera = found.camera
    size = np.array([camera.width, camera.height])
    # The kind of lens is told of a fisheye camera alone: files of others are as they were before there was one.
    params = camera.params if camera.lens.kind != RadialTangential.kind else camera.params[:-1]
    head = {"version": np.array(VERSION), "camera": params, "image_size": size}
    save_arrays(path, head | {"alignment": np.array(found.alignment)} | arrays)


def read_known_map(path: Path) -> KnownMap:
    """Reads the file, or that of a run's folder.

    Raises:
        InputError: it is missing, damaged, of another version, or holds too few points.
    """
    if path.is_dir():
        path = path / NAME
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such map; expected the folder of a finished `rbpf run mono`, or its {NAME}"
        )
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path} is larger than any map")
    arrays = load_arrays(path)
    version = arrays.get("version", np.zeros(()))
    if version.shape or version.dtype.kind != "i" or int(version) != VERSION:
        raise InputError(f"{path} is no map of this version of the program: map again")
    try:
        found = _parsed(arrays)
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is damaged: {' '.join(str(error).split())}") from error
    if found.names.size < LEAST:
        raise InputError(
            f"{path} holds {found.names.size} points of known depth, expected at least {LEAST}: map for longer"
        )
    return found


def _parsed(arrays: dict[str, np.ndarray]) -> KnownMap:
    count, views = arrays["names"].size, arrays["views"].shape[0]
    if arrays["camera"].shape == (9,):
        arrays = arrays | {"camera": np.append(arrays["camera"], RadialTangential.kind)}
    shapes = {
        "camera": (10,), "image_size": (2,), "names": (count,), "positions": (count, 3), "cov": (count, 3, 3),
        "windows": (count, _SIDE, _SIDE), "first_px": (count, 2), "first_pose": (count, 7), "views": (views, 7),
    }  # fmt: skip
    for name, shape in shapes.items():
        array = arrays[name]
        kind = {"names": "i", "image_size": "i", "windows": "u"}.get(name, "f")
        if array.shape != shape or array.dtype.kind != kind or not np.isfinite(array).all():
            raise ValueError(
                f"expected {name} of shape {shape}, finite, found {array.shape} of {array.dtype}"
            )
    if not views or (np.linalg.eigvalsh(arrays["cov"]) < 0.0).any():
        raise ValueError("expected views, and covariances that are none less than zero")
    width, height = (int(value) for value in arrays["image_size"])
    camera = Pinhole.from_params(width, height, arrays["camera"])
    alignment = _ALIGNMENTS[str(arrays["alignment"])]
    rest = (
        arrays[name] for name in ("names", "positions", "cov", "windows", "first_px", "first_pose", "views")
    )
    return KnownMap(camera, alignment, *rest)
