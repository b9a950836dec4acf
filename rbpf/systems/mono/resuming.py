"""Checkpoints of a run over images: the filter, the sensor, and what was gathered frame by frame."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbpf.core.archive import checked
from rbpf.core.checkpoint import fitting
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.systems.mono.video import VideoRun


_PER_FRAME = (
    "world_from_camera", "cov", "searched", "found", "lost", "ess", "log_evidence", "resampled", "nis", "nis_dof",
    "seconds", "seconds_search", "seconds_waiting", "seconds_new_landmarks", "seconds_telling",
)  # fmt: skip


def save(run: "VideoRun", path: Path) -> None:
    """Writes a checkpoint of the filter, the sensor and everything gathered so far."""
    done = run.filter.steps
    arrays = {f"progress/{name}": getattr(run, name)[:done] for name in _PER_FRAME}
    arrays["progress/stamps_ns"] = run.stamps_ns
    arrays["progress/problems"] = np.array(run.problems, dtype=np.str_)
    arrays["progress/relocalisations"] = np.array(run.relocalisations, dtype=np.int64)
    for part in (run.sensor, run.sightings, run.recovery, run.start):
        arrays |= part.arrays()
    run.filter.save(path, arrays)


def restore(run: "VideoRun", path: Path) -> None:
    """The inverse of `save`.

    Raises:
        InputError: the file is damaged, or belongs to a run over another sequence or with other settings.
    """
    arrays = run.filter.load(path)
    if not np.array_equal(arrays.get("progress/stamps_ns", ()), run.stamps_ns):
        raise InputError(f"{path} belongs to a run over another sequence: start without --resume")
    with fitting(path):
        for name in _PER_FRAME:
            getattr(run, name)[: run.filter.steps] = arrays[f"progress/{name}"]
        run.problems = checked(arrays, "progress/problems", (None,), "U").tolist()
        run.relocalisations = checked(arrays, "progress/relocalisations", (None,), "i").tolist()
        run.sensor.restore(arrays)
        run.sightings.restore(arrays)
        run.recovery.restore(arrays)
        run.start.restore(arrays)


def cut(run: "VideoRun") -> None:
    """Leaves the frames that were filtered: a video may end before its last announced image."""
    done = run.filter.steps
    run.stamps_ns = run.stamps_ns[:done]
    for name in _PER_FRAME:
        setattr(run, name, getattr(run, name)[:done])
