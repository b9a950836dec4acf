"""What a run says about its own honesty, without anything to compare it with."""

import numpy as np

from rbpf.errors import InputError
from rbpf.validation.comparison import Comparison
from rbpf.validation.run_record import RunRecord
from rbpf.validation.statistic import Statistic, motion_statistics, step_ratio

INNOVATIONS = "innovations of the measurements"


def own_statistics(record: RunRecord) -> list[Statistic]:
    """Innovations two-sided, and what they say about the motion where the system tells it.

    Without truth they find wrong noise of sensors and of the odometry, its bias, wrong associations and gross errors of
    a model. They do not find a filter whose particles agree on a wrong path that explains the measurements.
    """
    table = record.table("diagnostics.csv")
    if not {"nis", "nis_dof"} <= table.keys():
        raise InputError(f"{record.folder / 'diagnostics.csv'} has no columns nis and nis_dof")
    innovations = step_ratio(INNOVATIONS, table["nis"], table["nis_dof"])
    motion: list[Statistic] = []
    try:
        path = record.path()
        motion = motion_statistics(path.correction, path.cov_correction)
    except InputError:
        pass  # a folder of another version has no such file; whoever needs the poses says so
    return [*([] if innovations is None else [innovations]), *motion]


def compare_with_itself(record: RunRecord) -> Comparison:
    """The run's own statistics as a comparison; its accuracy stays open."""
    statistics = own_statistics(record)
    figures = {statistic.name: statistic.value for statistic in statistics if np.isfinite(statistic.value)}
    return Comparison("itself", "", figures, statistics)
