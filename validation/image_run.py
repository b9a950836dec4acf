"""The batch optimum of a stereo run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.folder import write_summary
from rbpf.runs.trajectory import write_tum
from rbpf.validation.gtsam.mono_batch import Batch

CHECKPOINT = "checkpoint.npz"

BATCH = "batch.tum"

Progress = Callable[[int, int], None]


def write_batch(
    out: Path,
    entries: dict[str, Any],
    adjust: Callable[[], Batch] | None,
    scores: Callable[[Batch], dict[str, Any]],
) -> Batch | None:
    """Writes the batch optimum's path, and its figures, or the reason why there is none, to summary.json.

    Args:
        out: the run's folder.
        entries: of summary.json; those of the batch are added.
        adjust: finds the optimum; what it raises as `InputError` is the reason. None leaves it out.
        scores: its figures.
    """
    (out / BATCH).unlink(missing_ok=True)
    if adjust is None:
        return None
    optimum = None
    try:
        optimum = adjust()
    except InputError as error:
        entries["batch_problem"] = str(error)
    if optimum is not None:
        write_tum(out / BATCH, optimum.trajectory)
        entries |= scores(optimum)
    write_summary(out, entries)
    return optimum
