"""What a run says about its own honesty, without anything to compare it with."""

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.comparison import Comparison
from rbpf.validation.consistency.statistic import Statistic, motion_statistics, step_ratio

INNOVATIONS = "innovations of the measurements"


def innovation_statistics(
    nis: np.ndarray, nis_dof: np.ndarray, correction: np.ndarray, cov_correction: np.ndarray
) -> list[Statistic]:
    """Innovations two-sided, and what they say about the motion.

    Without truth they find wrong noise of sensors and of the odometry, its bias, wrong associations and gross errors of
    a model. They do not find a filter whose particles agree on a wrong path that explains the measurements.

    Args:
        nis: (T,) normalised innovation squared.
        nis_dof: (T,) its degrees of freedom.
        correction: (T, r), see `rbpf.core.diagnostics.Correction`; r = 0 where the system does not tell them.
        cov_correction: (T, r, r).
    """
    innovations = step_ratio(INNOVATIONS, nis, nis_dof)
    motion = motion_statistics(correction, cov_correction) if correction.shape[1] else []
    return [*([] if innovations is None else [innovations]), *motion]


def own_statistics(record: RunFolder) -> list[Statistic]:
    """`innovation_statistics` of a run folder.

    Raises:
        InputError: its diagnostics are missing or damaged.
    """
    table = record.table("diagnostics.csv")
    if not {"nis", "nis_dof"} <= table.keys():
        raise InputError(f"{record.folder / 'diagnostics.csv'} has no columns nis and nis_dof")
    correction, cov = np.zeros((0, 0)), np.zeros((0, 0, 0))
    try:
        path = record.path
        correction, cov = path.correction, path.cov_correction
    except InputError:
        pass  # a folder of another version has no such file; whoever needs the poses says so
    return innovation_statistics(table["nis"], table["nis_dof"], correction, cov)


def compare_with_itself(record: RunFolder) -> Comparison:
    """The run's own statistics as a comparison; its accuracy stays open."""
    statistics = own_statistics(record)
    figures = {statistic.name: statistic.value for statistic in statistics if np.isfinite(statistic.value)}
    return Comparison("itself", "", figures, statistics)
