"""How far a run's path and map, or the truth, are from COLMAP's reconstruction: camera centres, and distances between clouds.

COLMAP's world and scale are its own: its cameras are brought onto the reference's by the best similarity, or by the
best rigid motion where a stereo pair gave the scale. Then one metre is the reference's.

Two detectors seldom choose the same spots, so the nearest point is about as far as the cloud is sparse. The distance
from the plane of the nearest points does not depend on that where the surface is smooth.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from scipy.spatial import cKDTree

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.runs.provenance import read_config
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import Similarity, Trajectory, associate
from rbpf.runs.truth import poses_at
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.colmap.model import OVER_IMAGES, recorded_images
from rbpf.validation.colmap.reconstruct import LEAST_FRAMES, Reconstruction, ReconstructionOptions, reconstruct
from rbpf.validation.metrics.accuracy import AbsoluteError, ate

NEIGHBOURS = 6  #: Points of the cloud that a plane is laid through.
LEAST_POINTS = 3  #: Of a cloud, for a plane.


@final
@dataclass(frozen=True, eq=False)
class CloudDistance:
    """Distances from M landmarks to a cloud."""

    nearest_m: Array  #: (M,) to the nearest point.
    surface_m: Array  #: (M,) to the plane that fits the nearest points best.
    sigmas: Array  #: (M,) the latter in the landmark's standard deviation across the plane.
    spacing_m: float  #: median distance from the nearest points to their own nearest neighbour.

    def as_dict(self) -> dict[str, Any]:
        """Quantiles for JSON."""
        figures = {"landmarks": len(self.nearest_m), "cloud_spacing_median_m": self.spacing_m}
        for name in ("nearest", "surface"):
            median, p90 = np.quantile(getattr(self, f"{name}_m"), [0.5, 0.9]).tolist()
            figures |= {f"{name}_median_m": median, f"{name}_p90_m": p90}
        figures["surface_median_sigmas"] = float(np.median(self.sigmas))
        return figures | {"share_within_3_sigmas": float((self.sigmas < 3.0).mean())}


@final
@dataclass(frozen=True, eq=False)
class ColmapComparison:
    """COLMAP beside a reference: the filter, or the truth."""

    reconstruction: Reconstruction
    path: AbsoluteError  #: distances of the camera centres, after the alignment that fits these best.
    #: brings COLMAP's world onto the reference's, by the cameras' orientations and centres.
    reference_from_colmap: Similarity
    cloud: CloudDistance | None  #: distances of the reference's landmarks; None without.
    extent_m: float  #: diagonal of the box that holds the reference's camera centres.

    def as_dict(self) -> dict[str, Any]:
        """Figures for JSON."""
        return {
            **self.reconstruction.as_dict(),
            "alignment": "rigid" if self.reconstruction.metric else "similarity",
            "scale": self.path.alignment.scale,
            "compared_frames": len(self.path.keys),
            "ate_rmse_m": self.path.rmse,
            "ate_median_m": self.path.median,
            "ate_max_m": self.path.max,
            "extent_m": self.extent_m,
            **({} if self.cloud is None else self.cloud.as_dict()),
        }


def compare_folder_with_colmap(
    folder: Path, options: ReconstructionOptions | None = None
) -> tuple[ColmapComparison, ColmapComparison | None]:
    """Reconstructs the images that a run folder's config.yaml names, which must still lie where they were, and compares."""
    config = read_config(folder)
    if config["system"] not in OVER_IMAGES:
        raise InputError(f"{folder} is a run of the system {config['system']}; COLMAP needs a run over images.")
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
) -> tuple[ColmapComparison, ColmapComparison | None]:
    """A run beside the reconstruction of its images, and this beside the truth: how good COLMAP itself is, None without."""
    found = reconstruct(sequence, options)
    run = compare_with_path(found, estimate.trajectory, estimate.landmarks)
    return run, None if sequence.truth is None else compare_with_truth(found, sequence.truth)


def compare_with_path(
    found: Reconstruction, reference: Trajectory, points: MapEstimate | None = None
) -> ColmapComparison:
    """COLMAP beside a filter's path and, if given, its map: poses at the key frames' times, of which there must be enough."""
    ours, theirs = associate(found.path, reference)
    if len(ours) < LEAST_FRAMES:
        raise InputError(
            f"COLMAP's key frames of {found.name} and the path share {len(ours)} instants, expected {LEAST_FRAMES} or more."
        )
    errors = ate(ours, theirs, "rigid" if found.metric else "similarity")
    # The mean rotation between the cameras, and the scale and shift that then fit the centres: centres on a short or
    # straight path leave the rotation open, and points far from it would be far off.
    mine, reference_poses = ours.world_from_body, theirs.world_from_body
    turns = SE3.compose(reference_poses, SE3.inverse(mine))
    turns[:, 4:] = 0.0
    rotation = SE3.rotation(SE3.mean(turns, np.full(len(turns), 1.0 / len(turns))))
    x, y = mine[:, 4:] @ rotation.T, reference_poses[:, 4:]
    dx, dy = x - x.mean(axis=0), y - y.mean(axis=0)
    square = float(np.square(dx).sum())
    scale = float((dx * dy).sum() / square) if not found.metric and square > 0.0 else 1.0
    move = Similarity(scale, rotation, y.mean(axis=0) - scale * x.mean(axis=0))
    cloud, extent = None, float(np.linalg.norm(np.ptp(theirs.positions, axis=0)))
    if points is not None and points.ids.size:
        cloud = cloud_distance(move.transform(found.points), points.mean, points.cov)
    return ColmapComparison(found, errors, move, cloud, extent)


def compare_with_truth(found: Reconstruction, truth: Truth) -> ColmapComparison:
    """COLMAP beside the truth, interpolated at the key frames; an InputError where there is too little."""
    rows, poses = poses_at(SE3, truth.stamps_ns, truth.poses, found.stamps_ns)
    if len(rows) < LEAST_FRAMES:
        raise InputError(
            f"The ground truth of {found.name} covers {len(rows)} of {len(found.frames)} key frames, expected "
            f"{LEAST_FRAMES} or more; its stamps must be those of the images' clock."
        )
    return compare_with_path(found, Trajectory(found.stamps_ns[rows], poses))


def cloud_distance(cloud: Array, landmarks: Array, cov_landmarks: Array) -> CloudDistance:
    """Distances of M >= 1 landmarks (M, 3), of covariances (M, 3, 3), to a cloud (P, 3) of P >= 3 points."""
    if len(cloud) < LEAST_POINTS or not len(landmarks):
        found = f"{len(cloud)} and {len(landmarks)}"
        raise InputError(f"Expected {LEAST_POINTS} or more points of a cloud and a landmark, found {found}.")
    tree = cKDTree(cloud)
    distances, rows = tree.query(landmarks, k=min(NEIGHBOURS, len(cloud)))
    spacing = tree.query(cloud[rows[:, 0]], k=2)[0][:, 1]
    around = cloud[rows]
    middle = around.mean(axis=1)
    normal = np.linalg.svd(around - middle[:, None])[2][:, 2]
    surface = np.abs(np.einsum("ki,ki->k", landmarks - middle, normal))
    sigmas = surface / np.sqrt(np.einsum("ki,kij,kj->k", normal, cov_landmarks, normal))
    return CloudDistance(distances[:, 0], surface, sigmas, float(np.median(spacing)))
