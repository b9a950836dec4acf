"""Checkpoints of a stereo run: the filter, the sensor, the odometry, and what was gathered pair by pair."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbpf.core.checkpoint import checked, fitting, within
from rbpf.core.particles import Estimate
from rbpf.errors import InputError

if TYPE_CHECKING:
    from rbpf.systems.stereo.run import StereoRun

_PER_FRAME = (
    "world_from_camera", "cov", "odometry", "features", "agreeing", "assumed", "updated", "observed", "ess",
    "resampled", "log_evidence", "nis", "nis_dof", "seconds", "seconds_features", "seconds_odometry",
    "seconds_matching", "seconds_filter",
)  # fmt: skip


def save(run: "StereoRun", path: Path) -> None:
    """Writes a checkpoint of everything so far."""
    done = run.frames_done
    arrays = {f"progress/{name}": getattr(run, name)[:done] for name in _PER_FRAME}
    arrays["progress/stamps_ns"] = run.stamps_ns
    arrays["progress/notes"] = np.array(run.notes, dtype=np.str_)
    arrays["progress/done"] = np.array([done, run.last_update])
    arrays["progress/at_update"] = run.at_update.mean
    arrays["progress/cov_at_update"] = run.at_update.cov
    run.filter.save(path, arrays | run.front_end.arrays() | run.reckoning.arrays() | run.seen.arrays())


def restore(run: "StereoRun", path: Path) -> None:
    """The inverse of `save`.

    Raises:
        InputError: the file is damaged, or belongs to a run over another recording or with other settings.
    """
    arrays = run.filter.load(path)
    if not np.array_equal(arrays.get("progress/stamps_ns", ()), run.stamps_ns):
        raise InputError(f"{path} belongs to a run over another recording: start without --resume")
    with fitting(path):
        run.frames_done, run.last_update = within(
            arrays, "progress/done", 2, 0, run.stamps_ns.size + 1
        ).tolist()
        for name in _PER_FRAME:
            getattr(run, name)[: run.frames_done] = arrays[f"progress/{name}"]
        run.notes = checked(arrays, "progress/notes", (None,), "U").tolist()
        run.at_update = Estimate(arrays["progress/at_update"], arrays["progress/cov_at_update"])
        run.front_end.restore(arrays)
        run.reckoning.restore(arrays)
        run.seen.restore(arrays)


def cut(run: "StereoRun") -> None:
    """Leaves the pairs that were filtered."""
    run.stamps_ns = run.stamps_ns[: run.frames_done]
    for name in _PER_FRAME:
        setattr(run, name, getattr(run, name)[: run.frames_done])
