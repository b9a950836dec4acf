"""Which measurement noise would make a run's innovations as large as the filter expects them.

With NIS per degree of freedom r and every measurement's standard deviation σ, innovations would be right at about σ √r
(R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", 1970, in its simplest form: the noise
of the measurements is taken to dominate what the filter expects). It is a hint for the next run, not an estimate:
errors that repeat from step to step, such as a known point that is given a little beside itself, are in no innovation.
"""

from typing import Any

from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.own_statistics import INNOVATIONS
from rbpf.validation.consistency.statistic import Statistic

SETTINGS = {"mono": ("search", "noise_px")}
"""By system, where its configuration holds the one standard deviation of all measurements, px."""


def noise_advice(record: RunFolder, statistics: list[Statistic]) -> str:
    """One sentence where innovations contradict the stated noise; empty where they do not."""
    found = [s for s in statistics if s.name == INNOVATIONS and s.outcome == "contradicts"]
    if not found or found[0].value <= 0.0:
        return ""
    factor = float(found[0].value) ** 0.5
    return (
        f"Innovations would be about as large as expected with {_how(record, factor)}; judge such a run beside the "
        "truth or a batch optimum, because errors that repeat from step to step do not show in innovations."
    )


def _how(record: RunFolder, factor: float) -> str:
    section, name = SETTINGS.get(record.system, ("", ""))
    settings: Any = record.config.get(section)
    value = settings.get(name) if isinstance(settings, dict) else None
    if isinstance(value, (int, float)) and value > 0:
        return f"--set {section}.{name}={factor * value:.2g} in place of {value:g}"
    return f"standard deviations of the measurements {factor:.2g} times as large"
