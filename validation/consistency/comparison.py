"""Comparisons of a run with a reference, in memory and in JSON; innovation statistics; and the overall verdict.

The verdict has two lights, each with a sentence: the accuracy of the path (`grade_path`), and whether its uncertainty is
reliable (`judge`), which follows from the statistics of `rbpf.validation.consistency.statistic` alone. They are independent:
an accurate path may be overconfident by far, and an inaccurate one consistent. The sentences are explained in
docs/how_to/report.md.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rbpf.errors import InputError
from rbpf.runs.files import COMPARISON, write_text
from rbpf.runs.plots import lost_frames
from rbpf.runs.reading import RunFolder
from rbpf.validation.consistency.statistic import BIAS_OF_MOTION, NOISE_FACTOR, Statistic, motion_statistics, step_ratio

INNOVATIONS, RESIDUALS = "innovations of the measurements", "residuals of the batch optimum"
#: By system, the setting with the common standard deviation of all measurements, px.
SETTINGS = {"mono": ("search", "noise_px")}


@dataclass(frozen=True)
class Comparison:
    """One comparison of a run."""

    against: str  #: name of the reference.
    accuracy: str  #: accuracy relative to it, a clause: "the path is … m from …".
    figures: dict[str, Any]  #: numbers by name.
    statistics: list[Statistic] = field(default_factory=list)  #: of the filter's consistency.
    pictures: list[str] = field(default_factory=list)  #: files in the run's folder.


def write_comparison(folder: Path, comparison: Comparison) -> Path:
    """Writes `validation_NAME.json`; returns its path."""
    entries = vars(comparison) | {"statistics": [statistic.entries() for statistic in comparison.statistics]}
    path = folder / f"{COMPARISON}{comparison.against}.json"
    write_text(path, json.dumps(entries, indent=2, allow_nan=False) + "\n")
    return path


def read_comparisons(folder: Path) -> tuple[list[Comparison], list[str]]:
    """All comparisons in a folder, by name; and a sentence on each file that is not one."""
    found, problems = [], []
    for path in sorted(folder.glob(f"{COMPARISON}*.json")):
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
            against, accuracy, figures = str(entries["against"]), str(entries["accuracy"]), dict(entries["figures"])
            statistics = [Statistic.of_entries(item) for item in entries["statistics"]]
            pictures = [Path(name).name for name in entries["pictures"]]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            problems.append(f"{path} is no comparison of this version of rbpf: delete it and validate again.")
            continue
        found.append(Comparison(against, accuracy, figures, statistics, pictures))
    return found, problems


def innovation_statistics(
    nis: np.ndarray, nis_dof: np.ndarray, correction: np.ndarray, cov_correction: np.ndarray
) -> list[Statistic]:
    """Two-sided innovation statistics, and those of the motion corrections.

    Without truth they detect wrong noise of sensors and odometry, odometry bias, wrong associations and gross model errors.
    They do not detect particles that agree on a wrong path that explains the measurements.

    `nis` (T,) with its degrees of freedom; corrections (T, r), (T, r, r) are those of `rbpf.core.diagnostics.Correction`,
    r = 0 if the system does not provide them.
    """
    innovations = step_ratio(INNOVATIONS, nis, nis_dof)
    motion = motion_statistics(correction, cov_correction) if correction.shape[1] else []
    return [*([] if innovations is None else [innovations]), *motion]


def compare_with_itself(record: RunFolder) -> Comparison:
    """A run's `innovation_statistics`, from its diagnostics, as a comparison without accuracy."""
    table = record.table("diagnostics.csv", "nis", "nis_dof")
    correction, cov = np.zeros((0, 0)), np.zeros((0, 0, 0))
    with suppress(InputError):  # a folder of another version has no such file; readers that need the poses report it
        correction, cov = record.corrections
    statistics = innovation_statistics(table["nis"], table["nis_dof"], correction, cov)
    figures = {statistic.name: statistic.value for statistic in statistics if np.isfinite(statistic.value)}
    return Comparison("itself", "", figures, statistics)


#: Largest plausible factor of wrongly stated noise; beyond it there is another cause.
MISSTATED = 5.0


def noise_advice(record: RunFolder, statistics: list[Statistic]) -> str:
    """A suggestion of the noise that would make innovations consistent, if they contradict the stated one; else empty.

    With NIS per degree of freedom r and standard deviation σ of every measurement, innovations would be consistent at about σ
    √r (R. K. Mehra, "On the identification of variances and adaptive Kalman filtering", 1970, in its simplest form:
    measurement noise is assumed to dominate the predicted covariance). It is a hint for the next run, not an estimate:
    systematic errors, such as a slightly wrong known point, are not in the innovations. Nothing is suggested that would make
    an overconfident filter more confident, nor a number that is not known to within `NOISE_FACTOR`, as after a few steps.
    """
    daring = any(s.kind == "ratio" and s.low > s.zone[1] for s in statistics)
    found = [s for s in statistics if s.name == INNOVATIONS and s.outcome == "contradicts"]
    if not found or found[0].value <= 0.0 or (daring and found[0].value < 1.0):
        return ""
    if found[0].high > NOISE_FACTOR**4 * found[0].low:  # of variances, both ways
        return ""
    factor = float(found[0].value) ** 0.5
    how = f"standard deviations of the measurements {factor:.2g} times as large"
    section, name = SETTINGS.get(record.system, ("", ""))
    settings: Any = record.config.get(section)
    value = settings.get(name) if isinstance(settings, dict) else None
    if isinstance(value, (int, float)) and value > 0:
        how = f"--set {section}.{name}={factor * value:.2g} in place of {value:g}"
    likelihood, false = record.config.get("likelihood"), ""
    if factor > MISSTATED and isinstance(likelihood, dict) and likelihood.get("kind") in (None, "gaussian"):
        false = (
            " So much is seldom noise: if some measurements are false, --set likelihood.kind=outliers leaves them out."
        )
    return (
        f"Innovations would be about as large as expected with {how}; judge such a run beside the truth or a batch "
        f"optimum, because errors that repeat from step to step do not show in innovations.{false}"
    )


def motion_advice(record: RunFolder, statistics: list[Statistic]) -> str:
    """A warning if a robot's odometry has systematic errors and the run has not estimated them; else empty."""
    biased = any(s.name == BIAS_OF_MOTION and s.outcome == "contradicts" for s in statistics)
    more = {"off": "odometry", "sensor": "online"}.get(str(record.config.get("calibrate")))
    able = record.config.get("association") == "known" and record.summary.get("map") == "joint"
    if not biased or more is None or not able:
        return ""
    return f"The odometry errs alike in all steps: in the plane --set calibrate={more} learns what wheels get wrong."


def calibration_advice(record: RunFolder, statistics: list[Statistic]) -> str:
    """A suggestion if the calibration contradicts the measurements and self-calibration is not used; else empty."""
    wrong = [s.name for s in statistics if s.kind == "calibration" and s.outcome == "contradicts"]
    if not wrong or record.config.get("calibrate") in ("sensor", "online"):
        return ""
    if record.system == "mono":
        return "--set calibrate=online finds focal lengths, k1 and k2 while it runs, rbpf recalibrate RUN afterwards."
    if wrong[0].startswith("ranges"):
        return "Either the ranges are wrong, or the distances of the odometry are, --set calibrate=odometry."
    return (
        "--set calibrate=sensor finds the sensor's place on the robot, its yaw where self_calibration.yaw_deg is not 0."
    )


Trust = Literal["trust", "do not trust", "cannot tell"]
Leaning = Literal["over-confident", "cautious", ""]
Grade = Literal["good", "fair", "poor", "not known"]
#: Grades of a path, with the largest error as a fraction of its spread, and the largest fraction of lost frames.
GRADES: tuple[tuple[Grade, float, float], ...] = (("good", 0.03, 0.05), ("fair", 0.1, 0.25))

_LEANINGS: dict[Leaning, str] = {
    "over-confident": "it claims to know more than it does (over-confident); ",
    "cautious": "it is larger than needed (cautious, not over-confident); ",
    "": "",
}

_OPENINGS: dict[Trust, str] = {
    "trust": "Trust its uncertainty",
    "do not trust": "Do not trust its uncertainty",
    "cannot tell": "Whether its uncertainty can be trusted cannot be told",
}


@dataclass(frozen=True)
class PathGrade:
    """The accuracy of a path."""

    grade: Grade = "not known"  #: the light.
    #: distance from the reference, and number of lost frames.
    sentence: str = "How far the path is from the right one is not known: the run was compared with nothing."


def grade_path(
    accuracy: str, error_m: float | None, spread_m: float | None, lost: int | None = None, frames: int = 0
) -> PathGrade:
    """The grade of a path.

    `accuracy` describes the distance from the reference, `error_m` is its root mean square, `spread_m` the root mean square
    distance of the reference from its centre. `lost` is None for systems that cannot be lost.
    """
    gone = 0.0 if lost is None else lost / max(frames, 1)
    by_loss = next((name for name, _, most in GRADES if gone <= most), "poor")
    grade: Grade = "poor" if by_loss == "poor" else "not known"
    said = [accuracy]
    if error_m is not None and spread_m:
        fraction = error_m / spread_m
        grade = next((name for name, least, most in GRADES if fraction <= least and gone <= most), "poor")
        said.append(f"That is {_number(100 * fraction)} % of its spread about its centre: {grade}.")
    if lost is not None:
        # Loss comes first: the error of a lost path is hardly meaningful.
        gone_frames = f"{lost or 'None'} of {frames} frames {'was' if lost == 1 else 'were'} lost."
        said.insert(0 if lost else len(said), gone_frames)
    return PathGrade(grade, " ".join(said))


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run."""

    path: PathGrade  #: accuracy of the path.
    trust: Trust  #: whether its uncertainty can be trusted.
    reason: str  #: the reason, a clause.
    leaning: Leaning = ""  #: direction in which an untrusted uncertainty is wrong, if known.
    advice: str = ""  #: suggestion for the next run, a sentence; or empty.
    problems: tuple[str, ...] = ()  #: files that could not be taken into account, a sentence each.

    @property
    def said(self) -> list[str]:
        """The problems, the sentences on path and uncertainty, and the advice, if any."""
        return [text for text in (*self.problems, *self.sentences, self.advice) if text]

    @property
    def sentences(self) -> tuple[str, str]:
        """Sentences on the path and on its uncertainty, each with a full stop."""
        return self.path.sentence, f"{_OPENINGS[self.trust]}: {_LEANINGS[self.leaning]}{self.reason}."


def judge(
    statistics: Sequence[Statistic],
    independent: Sequence[str] = (),
    path: PathGrade | None = None,
    truth: Sequence[str] = (),
) -> Verdict:
    """The verdict from all statistics.

    `independent` names the statistics that compare poses or landmarks with an external reference, `truth` those of them that
    use the truth, which unlike the batch posterior does not share the run's noise.
    """
    path = path or PathGrade()
    judging = [s for s in statistics if s.name in independent and s.kind != "calibration"]
    support = [s for s in judging if s.outcome == "supports"]
    told = [s for s in support if s.name in truth and s.kind == "ratio"]
    # A calibration is good enough if the run's errors relative to the truth are consistent.
    calibration = [s for s in statistics if s.kind == "calibration" and not told]
    against = [s for s in statistics if s.outcome == "contradicts" and (s.kind != "calibration" or s in calibration)]
    # Statistics that show overconfidence; else those that may show underconfidence.
    daring = [s for s in against if (s.high < s.zone[0]) == (s.kind == "share")]
    witnesses = [s for s in against if s.name in independent]
    if against and (daring or witnesses or not told):
        more = f" ({len(against) - 1} more of {len(statistics)} statistics contradict it)" if len(against) > 1 else ""
        alone = all(s.kind == "calibration" for s in against)
        worst = against[0] if alone else max(daring or witnesses or against, key=_distance)
        if daring or witnesses:
            leaning: Leaning = "over-confident" if daring else "cautious"
            return Verdict(path, "do not trust", described(worst) + more, leaning)
        reason = f"{described(worst)}{more}; the noise is not the stated one, and to which side the poses err "
        return Verdict(path, "do not trust", f"{reason}innovations do not tell")
    doubtful = [s for s in judging if s.kind == "ratio" and s.samples >= 1.0 and not s.zone[0] <= s.value <= s.zone[1]]
    # The batch posterior has the run's noise and calibration: without the truth no innovation may be larger than expected.
    noise = [s for s in statistics if s.name in (INNOVATIONS, RESIDUALS)]
    doubtful += [s for s in noise if not told and s.samples >= 1.0 and s.value > s.zone[1]]
    doubtful += calibration
    if support and not doubtful and (told or noise):
        but = f"; but noise is stated too large: {described(max(against, key=_distance))}" if against else ""
        return Verdict(path, "trust", described((told or support)[0]) + but)
    if support and not doubtful:
        reason = (
            f"{described(support[0])}, but the batch optimum has the run's own calibration and noise, and no innovation "
            "tells whether these are right; compare it with the truth"
        )
    elif doubtful and doubtful[0].kind == "calibration":
        reason = f"{described(doubtful[0])}: more than chance allows for, and less than would be beyond doubt"
    elif judging:
        first = (doubtful or judging)[0]
        zone = first.zone if first.kind != "ratio" else tuple(map(_root, first.zone))
        worth = f"{first.samples:.0f} independent sample{'s'[: first.samples >= 1.5]}"
        reason = (
            f"{described(first)}; the run is worth only {worth} of it, too few to say "
            f"that this lies within {_number(max(zone[0], 0.0))} to {_number(zone[1])}, or that it does not"
        )
    elif statistics:
        reason = (
            "nothing contradicts it, but a filter that agrees with itself can still be on a wrong path; compare it "
            "with the truth or a batch optimum"
        )
    else:
        reason = "nothing in the run says how large its errors are beside what it claims"
    return Verdict(path, "cannot tell", reason)


def verdict_of(record: RunFolder, comparisons: list[Comparison]) -> Verdict:
    """The verdict on a run from all its comparisons, the truth's first and its own statistics among them."""
    statistics = [statistic for comparison in comparisons for statistic in comparison.statistics]
    by_name = {comparison.against: comparison for comparison in comparisons if comparison.accuracy}
    accuracy, figures, key = PathGrade().sentence, {}, "position_rmse_m"
    if "groundtruth" in by_name:
        accuracy, figures = by_name["groundtruth"].accuracy, by_name["groundtruth"].figures
    elif by_name:
        best = by_name.get("relations", by_name.get("gtsam", next(iter(by_name.values()))))
        accuracy = best.accuracy
        if best.against != "relations":
            accuracy += " How far it is from the truth is not known."
        figures, key = best.figures, "filter_minus_batch_rmse_m"
    lost, frames = None, 0
    with suppress(InputError):
        able = {"lost", "assumed"} & record.table("diagnostics.csv").keys()
        lost, frames = int(lost_frames(record).sum()) if able else None, len(record.trajectory)
    path = grade_path(accuracy, figures.get(key), figures.get("path_spread_m"), lost, frames)
    # Statistics that compare poses or landmarks with an external reference.
    independent = [s.name for c in comparisons if c.accuracy for s in c.statistics if s.name != RESIDUALS]
    truth = [s.name for c in comparisons if c.against == "groundtruth" for s in c.statistics]
    verdict = judge(statistics, independent, path, truth)
    advice = [advise(record, statistics) for advise in (calibration_advice, motion_advice, noise_advice)]
    return replace(verdict, advice=" ".join(filter(None, advice)))


def described(statistic: Statistic) -> str:
    """A statistic in words: its value, its interval, and the consistent value."""
    value, low, high = statistic.value, statistic.low, statistic.high
    if statistic.kind == "bias":
        return (
            f"the {statistic.name} is {value:.2g} of its standard deviations in every step "
            f"({low:.2g} to {high:.2g}; up to {statistic.zone[1]:g} is harmless)"
        )
    if statistic.kind == "calibration":
        return f"{statistic.name}, {value:.2g} standard deviations from it"
    if statistic.kind == "share":
        return f"{statistic.name}: {100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    times, least, most = (_number(_root(ratio)) for ratio in (value, low, high))
    found = f"errors are {times} times as large as it claims ({least} to {most}, where 1 is right)"
    if value <= 0.0:
        side = "far too large"
    elif abs(np.log(_root(value))) <= np.log(1.1):
        side = "right within a tenth"
    elif statistic.outcome == "supports":
        side = f"right within a factor of {_number(_root(statistic.zone[1]))}"
    else:
        side = f"too {'small' if value > 1.0 else 'large'}"
    return f"{statistic.name}: {found}, its standard deviations are {side}"


def _root(ratio: float) -> float:
    """Converts a ratio of variances to one of standard deviations, for readers."""
    return float(np.sqrt(max(ratio, 0.0)))


def _distance(statistic: Statistic) -> float:
    """How far an interval is outside its zone, as a factor."""
    low, high = statistic.zone
    if statistic.low > high:
        return statistic.low / max(high, 1e-9)
    return max(low, 1e-9) / max(statistic.high, 1e-9)


def distance(metres: float) -> str:
    """A distance in a readable unit."""
    return f"{1e3 * metres:.3g} mm" if metres < 1.0 else f"{metres:.3g} m"


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "any number"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"
