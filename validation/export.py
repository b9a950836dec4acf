"""Any run as files for other programs: a COLMAP model, a PLY of the map and a PLY of the path.

colmap/     cameras, images, points and tracks (`cameras`, `images`, `points3D`, `rigs`, `frames`; .bin or .txt)
map.ply     landmarks, coloured by their standard deviation, which is also the property sigma_m
path.ply    positions of the body, joined by lines
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import prepare_folder
from rbpf.runs.path_and_map import PathAndMap
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.map_estimate import MapEstimate
from rbpf.validation.colmap.model import build_model
from rbpf.validation.gtsam.batch_problem import Problem
from rbpf.validation.gtsam.observations import ObservationTable, observation_table
from rbpf.validation.ply import write_ply
from rbpf.validation.report.colours import colours_by_sigma, standard_deviations

MAP, PATH, MODEL = "map.ply", "path.ply", "colmap"

NOMINAL = Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
"""Camera that stands for a robot's sensor in a COLMAP model: it looks along the robot's x axis and measures nothing."""

_PATH_COLOUR = np.array([[31, 119, 180]], dtype=np.uint8)
_BODY_FROM_CAMERA = SE3.from_matrix(
    np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
)


def export_colmap(
    estimate: PathAndMap, problem: Problem | None, folder: Path, kind: Literal["binary", "text"] = "binary"
) -> Any:
    """Writes a run as a COLMAP model and returns the `pycolmap.Reconstruction`.

    The images of a camera are named by their frame. Without a camera the poses are those of `NOMINAL` on the robot.

    Args:
        estimate: the run's path and map.
        problem: its measurements, for the camera and the tracks; None gives points without tracks.
        folder: for the model's files.
        kind: of the files.

    Raises:
        InputError: path and measurements are not of one run.
    """
    prepare_folder(folder)
    model = colmap_model(estimate, problem)
    if kind == "text":
        model.write_text(folder)
    else:
        model.write_binary(folder)
    return model


def colmap_model(estimate: PathAndMap, problem: Problem | None) -> Any:
    """The model that `export_colmap` writes."""
    landmarks = raised(estimate.landmarks)
    colours = colours_by_sigma(standard_deviations(estimate.landmarks.cov))
    if not isinstance(problem, FeatureLog):
        body = estimate.trajectory.world_from_body
        nothing = _no_sightings(NOMINAL, landmarks.ids)
        return build_model(nothing, SE3.compose(body, _BODY_FROM_CAMERA), landmarks.mean, colours)
    if len(problem.frames) != len(estimate.stamps_ns):
        counts = f"{len(estimate.stamps_ns)} poses and {len(problem.frames)} frames"
        raise InputError(
            f"{problem.name}: expected a pose for each frame, found {counts}; take both from one run."
        )
    return build_model(
        _on_map(observation_table(problem), landmarks.ids), estimate.world_from_body, landmarks.mean, colours
    )


def export_ply(estimate: PathAndMap, folder: Path) -> list[str]:
    """Writes map.ply and path.ply; returns their names."""
    prepare_folder(folder)
    landmarks, std = raised(estimate.landmarks), standard_deviations(estimate.landmarks.cov)
    write_ply(folder / MAP, landmarks.mean, colours_by_sigma(std), std)
    at = estimate.trajectory.positions
    steps = np.arange(max(len(at) - 1, 0))
    edges = np.stack([steps, steps + 1], axis=1)
    write_ply(folder / PATH, at, np.repeat(_PATH_COLOUR, len(at), axis=0), edges=edges)
    return [MAP, PATH]


def raised(landmarks: MapEstimate) -> MapEstimate:
    """Landmarks of the plane at height 0, with no spread above it."""
    more = (0, 3 - landmarks.mean.shape[1])
    mean, cov = np.pad(landmarks.mean, ((0, 0), more)), np.pad(landmarks.cov, ((0, 0), more, more))
    return replace(landmarks, mean=mean, cov=cov)


def _on_map(table: ObservationTable, ids: NDArray[np.int64]) -> ObservationTable:
    """The sightings of the map's landmarks, with the places of these in the map."""
    order = np.argsort(ids, kind="stable")
    kept = np.isin(table.names, ids)[table.index]
    place = order[np.searchsorted(ids, table.names[table.index[kept]], sorter=order)]
    return ObservationTable(table.camera, table.steps[kept], place, ids, table.z[kept], table.cov_z[kept])


def _no_sightings(camera: Pinhole, ids: NDArray[np.int64]) -> ObservationTable:
    none = np.zeros(0, dtype=np.intp)
    return ObservationTable(camera, none, none, ids, np.zeros((0, 2)), np.zeros((0, 2, 2)))
