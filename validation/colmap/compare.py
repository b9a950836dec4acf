"""Reconstruction by COLMAP, and its comparison with a run's path and map, or the truth.

It is made from key frames of a sequence: its own features, no knowledge of the filter. SIFT, sequential matching, incremental
mapping; the calibration is fixed. It shares only the images and the calibration with the filter.
Of a stereo sequence both images take part as if two cameras had been there, and the known baseline gives the scale.
J. L. Schönberger and J.-M. Frahm, "Structure-from-motion revisited" (2016).

Compared are camera centres, and distances between clouds.

COLMAP's world and scale are arbitrary: its cameras are aligned to the reference's by the best similarity, or by the best
rigid motion if a stereo pair gave the scale. One metre is then the reference's.

Two detectors seldom choose the same spots, so the nearest point is about as far as the cloud is sparse. The distance
from the plane of the nearest points does not depend on that where the surface is smooth.
"""

from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rbpf.errors import InputError
from rbpf.lie import SE3, Array
from rbpf.ranges import Angle, Count, Ranged, Seed
from rbpf.runs.provenance import read_config
from rbpf.runs.reading import PathAndMap, RunFolder
from rbpf.runs.trajectory import Similarity, Trajectory, associate
from rbpf.runs.truth import poses_at
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import ImageSequence
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.colmap.model import OVER_IMAGES, from_colmap_pose, recorded_images, to_colmap_camera
from rbpf.validation.metrics.accuracy import AbsoluteError, ate

LEAST_FRAMES = 3  #: Least key frames; two have no third view to detect wrong matches.
OVERLAP = 10  #: Each key frame is matched with this many that follow, and with those 2^i further on.
NEIGHBOURS = 6  #: Points of the cloud that a plane is laid through.
LEAST_POINTS = 3  #: Of a cloud, for a plane.


@final
@dataclass(frozen=True)
class ReconstructionOptions(Ranged):
    """How images are reconstructed."""

    every: Count = 5  #: every n-th frame is a key frame, from the first on.
    features: Count = 4096  #: maximum number per image.
    least_angle_deg: Angle = 16.0  #: between the rays of the two images that it begins with.
    seed: Seed = 0  #: of RANSAC.


@final
@dataclass(frozen=True, eq=False)
class Reconstruction:
    """COLMAP's reconstruction, in its own world; in metres if a baseline gives the scale."""

    name: str  #: of the sequence.
    chosen: NDArray[np.int64]  #: (C,) frames that were handed to it.
    frames: NDArray[np.int64]  #: (R,) those with a reconstructed pose, ascending.
    path: Trajectory  #: (R,) the poses, with the frames' times.
    points: Array  #: (M, 3).
    metric: bool  #: whether the scale is that of a stereo pair's baseline; otherwise it is arbitrary.
    model: Any  #: the `pycolmap.Reconstruction`, in the same scale.

    @property
    def fraction(self) -> float:
        """Share of the key frames whose pose was found."""
        return len(self.frames) / len(self.chosen)

    def as_dict(self) -> dict[str, Any]:
        """Figures for JSON."""
        return {
            "sequence": self.name,
            "key_frames": len(self.chosen),
            "registered": len(self.frames),
            "share_registered": self.fraction,
            "points": len(self.points),
            "reprojection_error_mean_px": self.model.compute_mean_reprojection_error(),
            "track_length_mean": self.model.compute_mean_track_length(),
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
    return Reconstruction(
        name=sequence.name,
        chosen=np.array(numbers, dtype=np.int64),
        frames=frames,
        path=Trajectory(np.asarray(sequence.stamps_ns)[frames], np.array([poses[frame] for frame in frames.tolist()])),
        points=np.array([by_id[index].xyz for index in sorted(by_id)]).reshape(-1, 3),
        metric=metric,
        model=model,
    )


def _side(model: Any, side: int) -> dict[int, Array]:
    """Poses (7,) by frame, of the left (0) or right (1) images."""
    found = [image for image in model.images.values() if image.has_pose and image.name.endswith(f"_{side}.png")]
    return {int(image.name.split("_")[0]): from_colmap_pose(image.cam_from_world()) for image in found}


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
    """COLMAP compared with a reference: the filter, or the truth."""

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
    """Compares a run with the reconstruction of its images, and that with the truth, None without."""
    found = reconstruct(sequence, options)
    run = compare_with_path(found, estimate.trajectory, estimate.landmarks)
    return run, None if sequence.truth is None else compare_with_truth(found, sequence.truth)


def compare_with_path(
    found: Reconstruction, reference: Trajectory, points: MapEstimate | None = None
) -> ColmapComparison:
    """Compares COLMAP with a filter's path and, if given, its map, at the key frames' times, of which enough are needed."""
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
    """Compares COLMAP with the truth, interpolated at the key frames. Raises InputError: there is too little truth."""
    rows, poses = poses_at(SE3, truth.stamps_ns, truth.poses, found.path.stamps_ns)
    if len(rows) < LEAST_FRAMES:
        raise InputError(
            f"The ground truth of {found.name} covers {len(rows)} of {len(found.frames)} key frames, expected "
            f"{LEAST_FRAMES} or more; its stamps must be those of the images' clock."
        )
    return compare_with_path(found, Trajectory(found.path.stamps_ns[rows], poses))


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
