"""A run over images beside a reconstruction of the same images by COLMAP, and the reconstruction beside the truth."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.provenance import read_config
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.sensors.readers import ImageSequence
from rbpf.validation.colmap.compare import ColmapComparison, compare_with_path, compare_with_truth
from rbpf.validation.colmap.images import OVER_IMAGES, recorded_images
from rbpf.validation.colmap.reconstruct import ReconstructionOptions, reconstruct


@final
@dataclass(frozen=True, eq=False)
class AgainstColmap:
    """A run beside COLMAP."""

    run: ColmapComparison  #: the run's path and map, as the reference that COLMAP's world is brought onto.
    truth: ColmapComparison | None  #: the ground truth as the reference: how good COLMAP itself is; None without.

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"run": self.run.as_dict(), "truth": None if self.truth is None else self.truth.as_dict()}


def compare_folder_with_colmap(folder: Path, options: ReconstructionOptions | None = None) -> AgainstColmap:
    """Reconstructs the images that a run folder's config.yaml names, which must still lie where they were, and compares.

    Raises:
        InputError: the run has no images, the folder is of another version, or the reconstruction fails.
    """
    config = read_config(folder)
    if config["system"] not in OVER_IMAGES:
        raise InputError(
            f"{folder} is a run of the system {config['system']}, which sees no images; COLMAP needs a run over images."
        )
    sequence = recorded_images(config)
    if config["system"] == "mono" and sequence.camera.lens.is_identity:
        # Where the recording is a rectified pair, of which the run saw the left images, both take part.
        with suppress(InputError):
            pair = recorded_images({**config, "system": "stereo"})
            if pair.camera == sequence.camera and np.array_equal(pair.stamps_ns, sequence.stamps_ns):
                sequence = pair
    return compare_with_colmap(RunFolder.open(folder).estimate, sequence, options)


def compare_with_colmap(
    estimate: PathAndMap, sequence: ImageSequence, options: ReconstructionOptions | None = None
) -> AgainstColmap:
    """A run's path and map beside the reconstruction of its images, and this beside the truth; see above."""
    found = reconstruct(sequence, options)
    points = estimate.landmarks
    run = compare_with_path(found, estimate.trajectory, points.mean, points.cov)
    return AgainstColmap(run, None if sequence.truth is None else compare_with_truth(found, sequence.truth))
