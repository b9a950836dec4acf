"""A reconstruction by COLMAP from key frames of a sequence: its own features, no knowledge of the filter.

SIFT, sequential matching, incremental mapping; the calibration is held fixed. What it finds shares the images and the
calibration with the filter and nothing else. Of a stereo sequence both images take part as if two cameras had been
there, and the known baseline gives the scale.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.validation.colmap.frames import from_colmap_pose
from rbpf.validation.colmap.pipeline import (
    LEAST_FRAMES,
    ReconstructionOptions,
    extract_and_match,
    is_stereo,
    map_images,
    quiet,
    write_key_frames,
)


@final
@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What COLMAP found, in a world of its own; in metres if a baseline told the scale.

    Attributes:
        name: of the sequence.
        camera: of the images.
        chosen: (C,) frames that were handed to it.
        frames: (R,) those of which it found the pose, ascending.
        stamps_ns: (R,) their times.
        world_from_camera: (R, 7).
        points: (M, 3).
        errors_px: (M,) mean reprojection error of each.
        track_lengths: (M,) images that show it.
        metric: whether the scale is that of a stereo pair's baseline; otherwise it is arbitrary.
        model: the `pycolmap.Reconstruction`, in the same scale.
    """

    name: str
    camera: Pinhole
    chosen: NDArray[np.int64]
    frames: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    world_from_camera: Array
    points: Array
    errors_px: Array
    track_lengths: NDArray[np.int64]
    metric: bool
    model: Any

    @property
    def fraction(self) -> float:
        """Share of the key frames whose pose was found."""
        return len(self.frames) / len(self.chosen)

    @property
    def path(self) -> Trajectory:
        """The poses with their times."""
        return Trajectory(self.stamps_ns, self.world_from_camera)

    def as_dict(self) -> dict[str, Any]:
        """Figures for JSON."""
        return {
            "sequence": self.name,
            "key_frames": len(self.chosen),
            "registered": len(self.frames),
            "share_registered": self.fraction,
            "points": len(self.points),
            "reprojection_error_mean_px": float(self.errors_px.mean()),
            "track_length_mean": float(self.track_lengths.mean()),
        }


def reconstruct(
    sequence: ImageSequence,
    options: ReconstructionOptions | None = None,
    folder: Path | None = None,
) -> Reconstruction:
    """Reconstructs a sequence of images from scratch.

    Args:
        sequence: of any reader.
        options: how.
        folder: for images, features and model, which stay there; by default a temporary one.

    Raises:
        InputError: too few key frames can be read, or COLMAP finds no model.
    """
    options = options or ReconstructionOptions()
    if folder is not None:
        return _reconstruct(sequence, options, folder)
    with TemporaryDirectory(prefix="colmap-") as temporary:
        return _reconstruct(sequence, options, Path(temporary))


def _reconstruct(sequence: ImageSequence, options: ReconstructionOptions, folder: Path) -> Reconstruction:
    images, database = folder / "images", folder / "database.db"
    images.mkdir(parents=True, exist_ok=True)
    database.unlink(missing_ok=True)
    chosen = write_key_frames(sequence, options, images)
    with quiet():
        extract_and_match(sequence.camera, options, images, database, 1 + is_stereo(sequence, options))
        model = _largest(map_images(options, images, database, folder))
    if model is None:
        raise InputError(
            f"COLMAP found no reconstruction of {sequence.name} from {len(chosen)} key frames: the images share too "
            "few features or the camera hardly moves between them; choose key frames closer together or farther apart."
        )
    return _result(sequence, chosen, model)


def _largest(models: dict[int, Any]) -> Any:
    fitting = [model for model in models.values() if len(_side(model, 0)) >= LEAST_FRAMES]
    return max(fitting, key=lambda model: (len(_side(model, 0)), model.num_points3D()), default=None)


def _side(model: Any, side: int) -> dict[int, Array]:
    """Poses (7,) by frame, of the left (0) or right (1) images."""
    found = [
        image for image in model.images.values() if image.has_pose and image.name.endswith(f"_{side}.png")
    ]
    return {int(image.name.split("_")[0]): from_colmap_pose(image.cam_from_world()) for image in found}


def _scale_by_baseline(sequence: ImageSequence, model: Any) -> bool:
    """Brings the model to metres; False where no pair was found."""
    import pycolmap

    left, right = _side(model, 0), _side(model, 1)
    both = sorted(left.keys() & right.keys())
    if sequence.baseline_m is None or not both:
        return False
    lengths = [np.linalg.norm(right[frame][4:] - left[frame][4:]) for frame in both]
    scale = sequence.baseline_m / float(np.median(lengths))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
    return True


def _result(sequence: ImageSequence, chosen: NDArray[np.int64], model: Any) -> Reconstruction:
    metric = _scale_by_baseline(sequence, model)
    found, by_id = _side(model, 0), dict(model.points3D)
    frames = np.array(sorted(found), dtype=np.int64)
    points = [by_id[index] for index in sorted(by_id)]
    return Reconstruction(
        name=sequence.name,
        camera=sequence.camera,
        chosen=chosen,
        frames=frames,
        stamps_ns=np.asarray(sequence.stamps_ns, dtype=np.int64)[frames],
        world_from_camera=np.array([found[frame] for frame in frames.tolist()]),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        errors_px=np.array([point.error for point in points]),
        track_lengths=np.array([point.track.length() for point in points], dtype=np.int64),
        metric=metric,
        model=model,
    )
