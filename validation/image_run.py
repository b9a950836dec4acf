"""What a monocular and a stereo run have in common after the filter: who is told, and the batch optimum."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rbpf.errors import InputError
from rbpf.runs.folder import write_summary
from rbpf.runs.trajectory import write_tum
from rbpf.validation.gtsam.mono_batch import Batch

CHECKPOINT = "checkpoint.npz"

BATCH = "batch.tum"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Telling:
    """Who is told how far the work after the filter is.

    Attributes:
        on_frame: called with the frames drawn and their number.
        on_iteration: called with the number of an iteration of the batch adjustment and the error before it.
        batch_s: time after which the batch adjustment is given up; None waits.
    """

    on_frame: Progress | None = None
    on_iteration: Callable[[int, float], None] | None = None
    batch_s: float | None = None


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
