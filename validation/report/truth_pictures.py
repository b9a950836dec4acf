"""Pictures of a run beside the truth, in the truth's world."""

import numpy as np

from rbpf.runs import plots
from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.against_groundtruth import TruthErrors
from rbpf.validation.report.comparison_figures import landmark_figure, map_figure, nees_figure, wide_axes


def draw_truth(record: RunFolder, errors: TruthErrors) -> list[str]:
    """Draws paths, errors with the filter's 3σ, NEES, landmarks and map into the run's folder; returns their names."""
    rows, name, white = errors.truth.rows, record.name, errors.whitened
    world = plots.World.of(record)
    known, dim = white.ranks > 0, white.errors.shape[1]
    figures = {
        "groundtruth_path.png": plots.path_figure(record),
        "groundtruth_error.png": plots.error_figure(record),
        "groundtruth_nees.png": nees_figure(f"{name}: NEES", rows[known], white.nees[known], dim),
    }
    if errors.landmarks is not None:
        found = errors.landmarks
        title = f"{name}: landmarks against the truth"
        figures["groundtruth_landmarks.png"] = landmark_figure(title, found.squares, found.white.shape[1])
        ours, (mean, cov) = world.of_filter(record).positions, found.map.in_space()
        true = np.pad(found.truth, ((0, 0), (0, 3 - found.truth.shape[1])))
        title = f"{name}: map over the truth, in {world.name}"
        figures["groundtruth_map.png"] = map_figure(title, ours, mean, cov, {"truth": true}, wide_axes(ours[rows]))
    return plots.save_figures(figures, record.folder)
