"""What two runs that should be the same are compared by: everything in their folders that does not tell times."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rbpf.runs.folder import RESULTS

STEPS = 20  #: Of the robot that is simulated.
#: What a run of every system leaves, of one with ground truth.
FILES = {
    "checkpoint.npz", "trajectory.tum", "trajectory.npz", "map.npz", "map.csv", "truth.npz", "observations.csv", "timings.csv",
    "diagnostics.csv", "config.yaml", "summary.json", "report.html", "path.png", "map.png", "particles.png", "error.png",
    "timings.png", "validation_groundtruth.json", "groundtruth_nees.png",
}  # fmt: skip
BATCH = {"batch.tum", "validation_gtsam.json", "gtsam_nees.png", "gtsam_landmarks.png", "gtsam_map.png"}
#: Entries of its summary.json.
REQUIRED = {"system", "recording", "frames", "particles", "seed", "ms_per_frame", "ate_rmse_m", "peak_memory_mb"}
#: Further ones of cameras.
OF_CAMERAS = {"ate_sim3_rmse_m", "rpe_translation_rmse_m", "rpe_rotation_rmse_deg"}

TIMED_FILES = {"timings.csv", "timings.png", "timings.pdf", "report.html", "checkpoint.npz"}
TIMED_ENTRIES = {"ms_per_frame", "ms_per_update", "peak_memory_mb", "finished"}


def untimed_summary(folder: Path) -> dict[str, Any]:
    """summary.json without times and memory."""
    entries = json.loads((folder / "summary.json").read_text())
    return {name: value for name, value in entries.items() if name not in TIMED_ENTRIES}


def names(folder: Path) -> set[str]:
    """Of all files; each picture lies there as vectors, too, which is not told again."""
    found = {path.name for path in folder.iterdir()}
    pictures, vectors = ({name[:-4] for name in found if name.endswith(ending)} for ending in (".png", ".pdf"))
    assert pictures == vectors
    assert {name for name in found if "_" not in name} <= {*RESULTS, "checkpoint.npz", "notes.txt"}
    return {name for name in found if not name.endswith(".pdf")}


def layout(recording: Path) -> tuple[set[str], np.ndarray, np.ndarray]:
    """Of a recording for the Rerun viewer the names of its views, where the world is looked at from, and to."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(recording)
    views, eye = set(), {}
    for batch in (chunk.to_record_batch() for store in reader.blueprints() for chunk in reader.stream(store=store)):
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            if name == "ViewBlueprint:display_name":
                views |= set(values.to_pylist()[0])
            elif name.startswith("EyeControls3D:"):
                eye[name.partition(":")[2]] = np.array(values.to_pylist()[0][0])
    return views, eye["position"], eye["look_target"]


def outputs(folder: Path) -> dict[str, bytes]:
    """The bytes of all files but timings, by name; of summary.json those of its other entries."""
    kept = {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in TIMED_FILES}
    return kept | {"summary.json": json.dumps(untimed_summary(folder)).encode()}
