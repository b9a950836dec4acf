"""Compares a finished run with the truth, the batch optimum or a reconstruction, and puts the result on its page.

A new comparison is one function from a run to a `Comparison`, entered into `COMPARISONS`.
"""

from collections.abc import Callable
from pathlib import Path

from rbpf.errors import InputError
from rbpf.runs.files import prepare_folder
from rbpf.runs.reading import RunFolder
from rbpf.runs.truth import TRUTH
from rbpf.validation.consistency.comparison import Comparison, clear_comparisons, write_comparison
from rbpf.validation.consistency.verdict import Verdict
from rbpf.validation.report.page import write_report

Compare = Callable[[RunFolder], Comparison]


def _groundtruth(record: RunFolder) -> Comparison:
    from rbpf.validation.consistency.against_groundtruth import compare_with_truth

    return compare_with_truth(record)


def _range_bearing_gtsam(record: RunFolder) -> Comparison:
    from rbpf.validation.consistency.against_gtsam import compare_with_batch

    return compare_with_batch(record)


def _camera_gtsam(record: RunFolder) -> Comparison:
    from rbpf.validation.consistency.offline_comparisons import compare_camera_with_batch

    return compare_camera_with_batch(record)


def _camera_colmap(record: RunFolder) -> Comparison:
    from rbpf.validation.consistency.offline_comparisons import compare_camera_with_colmap

    return compare_camera_with_colmap(record)


ANY = "*"
COMPARISONS: dict[str, dict[str, Compare]] = {
    "groundtruth": {ANY: _groundtruth},
    "gtsam": {"range-bearing": _range_bearing_gtsam, "mono": _camera_gtsam, "stereo": _camera_gtsam},
    "colmap": {"mono": _camera_colmap, "stereo": _camera_colmap},
}
"""By what a run is compared with, then by the run's system."""


def validate(folder: Path, against: str, out: Path | None = None) -> Verdict:
    """Compares a run, writes `validation_AGAINST.json` and the pictures, and builds the report again.

    Args:
        folder: of the run.
        against: a name in `COMPARISONS`.
        out: a further folder for the JSON.

    Returns:
        The verdict on the run.

    Raises:
        InputError: the comparison is not possible; the report is written all the same, and says why.
    """
    record = RunFolder.open(folder)
    try:
        comparison = _comparison(record.system, against)(record)
    except InputError as error:
        write_report(folder, [f"Not compared with {against}: {error}."])
        raise
    write_comparison(folder, comparison)
    if out is not None:
        prepare_folder(out)
        write_comparison(out, comparison)
    return write_report(folder)


def report_run(folder: Path) -> Verdict:
    """The page of a run that has just finished: compared with the truth where its recording has one."""
    clear_comparisons(folder)
    if (folder / TRUTH).is_file():
        return validate(folder, "groundtruth")
    return write_report(folder)


def _comparison(system: str, against: str) -> Compare:
    known = COMPARISONS.get(against)
    if known is None:
        raise InputError(f"a run is compared with {', '.join(COMPARISONS)}, not with {against}")
    compare = known.get(system, known.get(ANY))
    if compare is None:
        able = ", ".join(sorted(known)) or "no system yet"
        raise InputError(
            f"a run of the system {system!r} cannot be compared with {against} (possible: {able})"
        )
    return compare
