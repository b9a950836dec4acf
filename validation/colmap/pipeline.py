"""The steps of COLMAP's pipeline: key frames to files, features, sequential matches, incremental mapping."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images.sequence import ImageSequence
from rbpf.validation.colmap.frames import camera_model

LEAST_FRAMES = 3
"""Key frames; two have no third view that tells a wrong match."""


@final
@dataclass(frozen=True)
class ReconstructionOptions:
    """How images are reconstructed.

    Attributes:
        every: every so many frames is a key frame, from the first on.
        features: most of them per image.
        overlap: each key frame is matched with so many that follow, and with those 2^i further on.
        stereo: of a stereo sequence take both images, and the scale from the baseline.
        least_angle_deg: between the rays of the two images that it begins with.
        threads: of extraction and matching; mapping takes one, so that the same seed gives the same model.
        seed: of RANSAC.
    """

    every: int = 5
    features: int = 4096
    overlap: int = 10
    stereo: bool = True
    least_angle_deg: float = 16.0
    threads: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks that the numbers make sense."""
        for name in ("every", "features", "overlap", "threads"):
            if getattr(self, name) < 1:
                raise InputError(f"Expected {name} to be at least 1, found {getattr(self, name)}.")
        if self.seed < 0:
            raise InputError(f"Expected a seed of at least 0, found {self.seed}.")


def write_key_frames(
    sequence: ImageSequence, options: ReconstructionOptions, images: Path
) -> NDArray[np.int64]:
    """Decodes and writes the key frames, as NUMBER_SIDE.png; their numbers (C,)."""
    import pycolmap

    chosen = []
    for number, frame in enumerate(sequence.frames()):
        if number % options.every or frame.image is None:
            continue
        sides = [frame.image]
        if is_stereo(sequence, options) and frame.right is not None:
            sides.append(frame.right)
        for side, image in enumerate(sides):
            pycolmap.Bitmap.from_array(image).write(images / f"{number:06d}_{side}.png")
        chosen.append(number)
    if len(chosen) < LEAST_FRAMES:
        raise InputError(
            f"{sequence.name} has {len(chosen)} readable key frames of {len(sequence)} images, expected "
            f"{LEAST_FRAMES} or more; choose a smaller step than every {options.every}."
        )
    return np.array(chosen, dtype=np.int64)


def is_stereo(sequence: ImageSequence, options: ReconstructionOptions) -> bool:
    """Whether both images of a pair take part."""
    return options.stereo and sequence.baseline_m is not None


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps COLMAP's progress off the terminal."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def extract_and_match(
    camera: Pinhole, options: ReconstructionOptions, images: Path, database: Path, images_per_frame: int
) -> None:
    """SIFT of all images, and verified matches with those that follow."""
    import pycolmap

    name, params = camera_model(camera)
    reading = pycolmap.ImageReaderOptions()
    reading.camera_model, reading.camera_params = name, ",".join(map(repr, params))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features, extraction.num_threads = options.features, options.threads
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reading,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.SequentialPairingOptions()
    matching.num_threads = pairing.num_threads = options.threads
    pairing.overlap = options.overlap * images_per_frame
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    pycolmap.match_sequential(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def map_images(options: ReconstructionOptions, images: Path, database: Path, folder: Path) -> dict[int, Any]:
    """Incremental mapping with the calibration held; models by number."""
    import pycolmap

    pycolmap.set_random_seed(options.seed)
    how = pycolmap.IncrementalPipelineOptions()
    how.num_threads, how.random_seed = 1, options.seed
    how.ba_refine_focal_length = how.ba_refine_principal_point = how.ba_refine_extra_params = False
    how.mapper.abs_pose_refine_focal_length = how.mapper.abs_pose_refine_extra_params = False
    how.mapper.init_min_tri_angle = options.least_angle_deg
    how.min_model_size, how.extract_colors = LEAST_FRAMES, False
    models = folder / "models"
    models.mkdir(exist_ok=True)
    return dict(pycolmap.incremental_mapping(database, images, models, how))
