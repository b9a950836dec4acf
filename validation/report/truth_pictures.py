"""Pictures of a run beside the truth."""

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE2, SE3
from rbpf.runs.plots import save_figures
from rbpf.runs.reading import FilteredPath, RunFolder
from rbpf.runs.trajectory import in_space, read_tum
from rbpf.validation.consistency.against_groundtruth import LandmarkErrors, TruthErrors
from rbpf.validation.report.comparison_figures import (
    error_figure,
    landmark_figure,
    map_figure,
    nees_figure,
    path_figure,
    wide_axes,
)


def draw_truth(record: RunFolder, errors: TruthErrors) -> list[str]:
    """Draws paths, errors with the filter's 3σ, NEES, landmarks and map into the run's folder; returns their names."""
    rows, name = errors.truth.rows, record.name
    moved = errors.positions.alignment
    path = errors.path.trajectory()
    ours = moved.transform(path.positions)
    true = in_space(errors.path.stamps_ns[rows], errors.truth.poses).positions
    curves = {"truth": true, "filter": ours}
    if (record.folder / "batch.tum").is_file():
        curves["batch"] = moved.transform(read_tum(record.folder / "batch.tum").positions)
    plane = wide_axes(true)
    std = moved.scale * position_std(errors.path, moved.rotation)[rows]
    figures = {
        "groundtruth_path.png": path_figure(f"{name}: paths", curves, plane),
        "groundtruth_error.png": error_figure(
            f"{name}: error of the position", rows, ours[rows] - true, std, lost_steps(record)[rows]
        ),
    }
    if errors.whitened is not None:
        known = errors.whitened.ranks > 0
        nees = errors.whitened.nees[known]
        figures["groundtruth_nees.png"] = nees_figure(
            f"{name}: NEES", rows[known], nees, errors.path.space.dim
        )
    if errors.landmarks is not None:
        dim = errors.landmarks.errors.shape[1]
        title = f"{name}: landmarks against the truth"
        figures["groundtruth_landmarks.png"] = landmark_figure(title, errors.landmarks.squares, dim)
        figures["groundtruth_map.png"] = _map(f"{name}: map over the truth", ours, errors.landmarks, plane)
    return save_figures(figures, record.folder)


def position_std(path: FilteredPath, rotation: np.ndarray) -> np.ndarray:
    """(T, 3) standard deviations of the positions along the axes of a world turned by a rotation (3, 3)."""
    local = np.zeros((len(path.mean), 3, 3))
    if path.space.dim == SE2.dim:
        local[:, :2, :2] = path.cov[:, 1:, 1:]
    else:
        local = path.cov[:, 3:, 3:]
    turn = rotation @ SE3.matrix(path.trajectory().world_from_body)[:, :3, :3]
    return np.sqrt(np.maximum(np.einsum("tab,tbc,tac->ta", turn, local, turn), 0.0))


def lost_steps(record: RunFolder) -> np.ndarray:
    """(T,) bool: where the run's own diagnostics say that it was lost."""
    try:
        table = record.table("diagnostics.csv")
    except InputError:
        table = {}
    return table.get("lost", np.zeros(len(record.path.mean))).astype(bool)


def _map(title: str, path: np.ndarray, landmarks: LandmarkErrors, plane: tuple[int, int]) -> object:
    count, dim = landmarks.errors.shape
    mean, cov = np.zeros((count, 3)), np.zeros((count, 3, 3))
    mean[:, :dim], cov[:, :dim, :dim] = landmarks.map.mean, landmarks.map.cov
    true = mean.copy()
    true[:, :dim] += landmarks.errors
    return map_figure(title, path, mean, cov, {"truth": true}, plane)
