"""A reconstruction by COLMAP from key frames of a sequence: its own features, no knowledge of the filter.

SIFT, sequential matching, incremental mapping; the calibration is held fixed. What it finds shares the images and the
calibration with the filter and nothing else. Of a stereo sequence both images take part as if two cameras had been
there, and the known baseline gives the scale.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).
"""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.ranges import Angle, Count, Ranged, Seed
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.validation.colmap.model import from_colmap_pose, to_colmap_camera

LEAST_FRAMES = 3  #: Key frames; two have no third view that tells a wrong match.
OVERLAP = 10  #: Each key frame is matched with so many that follow, and with those 2^i further on.


@final
@dataclass(frozen=True)
class ReconstructionOptions(Ranged):
    """How images are reconstructed."""

    every: Count = 5  #: every so many frames is a key frame, from the first on.
    features: Count = 4096  #: most of them per image.
    least_angle_deg: Angle = 16.0  #: between the rays of the two images that it begins with.
    seed: Seed = 0  #: of RANSAC.


@final
@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What COLMAP found, in a world of its own; in metres if a baseline told the scale."""

    name: str  #: of the sequence.
    chosen: NDArray[np.int64]  #: (C,) frames that were handed to it.
    frames: NDArray[np.int64]  #: (R,) those of which it found the pose, ascending.
    stamps_ns: NDArray[np.int64]  #: (R,) their times.
    world_from_camera: Array  #: (R, 7).
    points: Array  #: (M, 3).
    errors_px: Array  #: (M,) mean reprojection error of each.
    track_lengths: NDArray[np.int64]  #: (M,) images that show it.
    metric: bool  #: whether the scale is that of a stereo pair's baseline; otherwise it is arbitrary.
    model: Any  #: the `pycolmap.Reconstruction`, in the same scale.

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


def reconstruct(sequence: ImageSequence, options: ReconstructionOptions | None = None) -> Reconstruction:
    """Reconstructs a sequence of images; an InputError where too few key frames can be read, or COLMAP finds no model."""
    import pycolmap

    options = options or ReconstructionOptions()
    is_stereo, numbers = sequence.baseline_m is not None, []
    with TemporaryDirectory(prefix="colmap-") as temporary, ExitStack() as afterwards:
        # COLMAP's progress is kept off the terminal.
        afterwards.callback(setattr, pycolmap.logging, "minloglevel", pycolmap.logging.minloglevel)
        pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
        images, models, database = (Path(temporary) / name for name in ("images", "models", "database.db"))
        images.mkdir()
        models.mkdir()
        # Key frames to files, as NUMBER_SIDE.png.
        for number, frame in enumerate(sequence.frames()):
            if number % options.every or frame.image is None:
                continue
            for side, image in enumerate((frame.image, frame.right if is_stereo else None)):
                if image is not None:
                    pycolmap.Bitmap.from_array(image).write(images / f"{number:06d}_{side}.png")
            numbers.append(number)
        if len(numbers) < LEAST_FRAMES:
            raise InputError(
                f"{sequence.name} has {len(numbers)} readable key frames of {len(sequence)} images, expected "
                f"{LEAST_FRAMES} or more; choose a smaller step than every {options.every}."
            )
        # SIFT of all images, and verified matches with those that follow.
        camera, reading = to_colmap_camera(sequence.camera), pycolmap.ImageReaderOptions()
        reading.camera_model, reading.camera_params = camera.model_name, ",".join(map(repr, camera.params.tolist()))
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.sift.max_num_features, extraction.num_threads = options.features, 1
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reading,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.SequentialPairingOptions()
        matching.num_threads = pairing.num_threads = 1
        pairing.overlap = OVERLAP * (1 + is_stereo)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = options.seed
        pycolmap.match_sequential(
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        # Incremental mapping with the calibration held.
        pycolmap.set_random_seed(options.seed)
        how = pycolmap.IncrementalPipelineOptions()
        how.num_threads, how.random_seed = 1, options.seed
        how.ba_refine_focal_length = how.ba_refine_principal_point = how.ba_refine_extra_params = False
        how.mapper.abs_pose_refine_focal_length = how.mapper.abs_pose_refine_extra_params = False
        how.mapper.init_min_tri_angle = options.least_angle_deg
        how.min_model_size, how.extract_colors = LEAST_FRAMES, False
        found = dict(pycolmap.incremental_mapping(database, images, models, how)).values()
    fitting = [model for model in found if len(_side(model, 0)) >= LEAST_FRAMES]
    model = max(fitting, key=lambda one: (len(_side(one, 0)), one.num_points3D()), default=None)
    if model is None:
        raise InputError(
            f"COLMAP found no reconstruction of {sequence.name} from {len(numbers)} key frames: the images share too "
            "few features or the camera hardly moves between them; choose key frames closer together or farther apart."
        )
    # Of pairs, the model is brought to metres.
    left, right = _side(model, 0), _side(model, 1)
    both = sorted(left.keys() & right.keys())
    metric = sequence.baseline_m is not None and bool(both)
    if sequence.baseline_m is not None and both:
        lengths = [np.linalg.norm(right[frame][4:] - left[frame][4:]) for frame in both]
        scale = sequence.baseline_m / float(np.median(lengths))
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
    poses, by_id = _side(model, 0), dict(model.points3D)
    frames = np.array(sorted(poses), dtype=np.int64)
    points = [by_id[index] for index in sorted(by_id)]
    return Reconstruction(
        name=sequence.name,
        chosen=np.array(numbers, dtype=np.int64),
        frames=frames,
        stamps_ns=np.asarray(sequence.stamps_ns, dtype=np.int64)[frames],
        world_from_camera=np.array([poses[frame] for frame in frames.tolist()]),
        points=np.array([point.xyz for point in points]).reshape(-1, 3),
        errors_px=np.array([point.error for point in points]),
        track_lengths=np.array([point.track.length() for point in points], dtype=np.int64),
        metric=metric,
        model=model,
    )


def _side(model: Any, side: int) -> dict[int, Array]:
    """Poses (7,) by frame, of the left (0) or right (1) images."""
    found = [image for image in model.images.values() if image.has_pose and image.name.endswith(f"_{side}.png")]
    return {int(image.name.split("_")[0]): from_colmap_pose(image.cam_from_world()) for image in found}
