"""Consistency of the filters: NEES over many simulated runs of both systems, with few and many particles.

The normalised estimation error squared (NEES) of the pose, averaged over independent recordings, is 1 per degree of
freedom for a consistent filter, and in the green band in 95 % of the steps. A filter is overconfident from the step at
which it leaves the band upwards for good (`left_for_good`). The upper plots show the curves for three numbers of
particles. The lower plots show, for the middle number, the effect of each remedy, or of its absence, on the mean over all
steps: iterating the proposal's linearisation, the exact importance ratio instead of the linearised weight, and
marginalising the frame of the known points instead of sampling the start (monocular).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.core.diagnostics import Band, ancestors_by_step, chi_square_band, coalescence_steps
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_features, filter_opened, open_robot_log
from rbpf.runs.run import Run
from rbpf.runs.truth import truth_at
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers import RobotLog
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.consistency.statistic import PROBABILITIES, whitened_errors
from rbpf.validation.simulation.robot import RobotWorld, simulated_log


@dataclass(frozen=True)
class Trial:
    """One run; T steps, M landmarks.

    Attributes:
        dim: degrees of freedom of the pose, d.
        distances: (T,) errors of the position, m, without alignment.
        nees: (T,) of the pose; NaN where the filter's pose is exact.
        nis: (T,) normalised innovation squared;  nis_dof: (T,) its degrees of freedom.
        landmark_nees: (M,) of the landmarks at the end;  landmark_dim: degrees of freedom of one.
        ancestors: (T,) number of particles of each step with descendants at the end.
        coalescence: steps back from the end to the latest common ancestor of all particles; None without one.
        log_evidence: of the whole run.
    """

    dim: int
    distances: np.ndarray
    nees: np.ndarray
    nis: np.ndarray
    nis_dof: np.ndarray
    landmark_nees: np.ndarray
    landmark_dim: int
    ancestors: np.ndarray
    coalescence: int | None
    log_evidence: float


@dataclass(frozen=True)
class RobotTrial:
    """Range-bearing SLAM in a simulated world; called with a seed of world and filter.

    Attributes:
        world: what is simulated.
        config: of the filter.
        spoil: changes the filter's input, after the simulation; None changes nothing.
    """

    world: RobotWorld
    config: RangeBearingConfig
    spoil: Callable[[RobotLog, np.random.Generator], RobotLog] | None = None

    def __call__(self, seed: int) -> Trial:
        """Simulates and filters."""
        log = simulated_log(self.world, seed)
        given = log if self.spoil is None else self.spoil(log, np.random.default_rng(seed))
        done = filter_opened(open_robot_log(given, replace(self.config, seed=seed)))
        path, found = done.log, done.system.map()
        assert log.truth is not None
        truth = truth_at(log.space, log.truth, path.stamps_ns, "first frame")
        assert truth is not None
        errors = whitened_errors(log.space, path.poses, path.covs, truth.poses)
        return Trial(
            log.space.dim,
            np.linalg.norm(path.poses[:, -found.mean.shape[1] :] - truth.poses[:, -found.mean.shape[1] :], axis=1),
            np.where(errors.ranks > 0, errors.nees, np.nan),
            path["nis"],
            path["nis_dof"],
            _landmark_nees(found, truth.landmarks),
            found.mean.shape[1],
            *_genealogy(done.system.filter),
        )


@dataclass(frozen=True)
class DeskTrial:
    """Monocular SLAM on simulated features; called with a seed of world and filter.

    Attributes:
        world: what is simulated.
        config: of the filter.
        measuring: settings of the measurements.
    """

    world: DeskWorld
    config: MonoConfig
    measuring: Measuring = field(default_factory=Measuring)

    def __post_init__(self) -> None:
        """Errors are without alignment, which requires known points.

        Raises:
            InputError: there are fewer than four.
        """
        if self.measuring.known < 4:
            raise InputError(
                f"a trial needs 4 known points or more to tell errors in one world, got {self.measuring.known}"
            )

    def __call__(self, seed: int) -> Trial:
        """Simulates and filters."""
        log = simulate_features(self.world, self.measuring, MONO, seed)
        return camera_trial(log, filter_features(log, replace(self.config, seed=seed)))


def camera_trial(log: FeatureLog, done: Run) -> Trial:
    """The trial of a filtered log whose ground truth starts with its run."""
    truth, path = done.truth, done.log
    assert truth is not None
    errors = whitened_errors(SE3, path.poses, path.covs, truth.poses)
    return Trial(
        6,
        np.linalg.norm(SE3.translation(path.poses) - SE3.translation(truth.poses), axis=1),
        np.where(errors.ranks > 0, errors.nees, np.nan),
        path["nis"],
        path["nis_dof"],
        _landmark_nees(done.system.map().points(), truth.landmarks),
        3,
        *_genealogy(done.system.filter),
    )


def _landmark_nees(found: MapEstimate, truth: dict[int, np.ndarray]) -> np.ndarray:
    known = np.array([name in truth for name in found.ids.tolist()], dtype=bool)
    error = np.array([truth[name] for name in found.ids[known].tolist()]).reshape(-1, found.mean.shape[1])
    error = error - found.mean[known]
    return np.einsum("md,mde,me->m", error, np.linalg.pinv(found.cov[known], hermitian=True), error)


def _genealogy(filter_: Filter) -> tuple[np.ndarray, int | None, float]:
    return ancestors_by_step(filter_.history), coalescence_steps(filter_.history), filter_.log_evidence


LAST = 10
"""Least number of steps after the start of overconfidence, to assert it."""


@dataclass(frozen=True)
class Mean:
    """A mean over independent runs, with its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray) -> "Mean":
        """Of one value per run."""
        numbers = np.asarray(values, dtype=float)
        spread = float(numbers.std(ddof=1)) if numbers.size > 1 else float("inf")
        return cls(float(numbers.mean()), float(spread / np.sqrt(numbers.size)))


@dataclass(frozen=True)
class Consistency:
    """Consistency of R runs of T steps.

    Attributes:
        trials: the runs.
    """

    trials: list[Trial]

    def __post_init__(self) -> None:
        """Checks that the runs are compatible.

        Raises:
            InputError: there is none, or they differ in length or dimension.
        """
        shapes = {(trial.dim, trial.nees.size) for trial in self.trials}
        if len(shapes) != 1:
            raise InputError(f"a test of consistency takes one or more runs of one kind and length, got {len(shapes)}")

    @property
    def dim(self) -> int:
        """Degrees of freedom of a pose, d."""
        return self.trials[0].dim

    @property
    def mean_nees(self) -> np.ndarray:
        """(T,) mean over the runs; NaN where the filter's pose is exact."""
        return np.mean([trial.nees for trial in self.trials], axis=0)

    def band(self, probability: float = 0.95) -> Band:
        """Interval of a consistent filter's mean NEES of one step, with a probability."""
        return chi_square_band(self.dim, len(self.trials), probability)

    @property
    def overconfident_from(self) -> int | None:
        """The step from which on the filter is overconfident, by `left_for_good`; None if it never is."""
        return left_for_good(self.mean_nees, self.band().high)

    @property
    def pose_nees(self) -> Mean:
        """Per degree of freedom, over all steps; 1 is right."""
        return Mean.of([float(np.nanmean(trial.nees)) / self.dim for trial in self.trials])

    @property
    def landmark_nees(self) -> Mean:
        """Per degree of freedom, over all landmarks of a run; 1 is right."""
        seen = [trial for trial in self.trials if trial.landmark_nees.size]
        return Mean.of([float(trial.landmark_nees.mean()) / trial.landmark_dim for trial in seen])

    @property
    def nis(self) -> Mean:
        """Per degree of freedom; 1 is right."""
        return Mean.of([_nis_ratio(trial) for trial in self.trials])

    @property
    def position_rmse(self) -> Mean:
        """Of one run, m, without alignment."""
        return Mean.of([float(np.sqrt(np.square(trial.distances).mean())) for trial in self.trials])

    def coverage(self, probability: float) -> Mean:
        """Fraction of true poses in the credible region of a probability."""
        from scipy.stats import chi2

        bound = chi2.ppf(probability, self.dim)
        known = [trial.nees[np.isfinite(trial.nees)] for trial in self.trials]
        return Mean.of([float((nees <= bound).mean()) for nees in known])

    @property
    def coalescence(self) -> float:
        """Median number of steps back to the latest common ancestor; infinite if most runs have none."""
        return float(np.median([np.inf if t.coalescence is None else t.coalescence for t in self.trials]))

    def ancestors(self, age: int) -> float:
        """Mean number of particles `age` steps before the end with descendants at the end."""
        return float(np.mean([trial.ancestors[max(trial.ancestors.size - 1 - age, 0)] for trial in self.trials]))

    def entries(self) -> dict[str, Any]:
        """All figures by name, for a table."""
        means = {
            "pose_nees": self.pose_nees,
            "landmark_nees": self.landmark_nees,
            "nis": self.nis,
            "position_rmse_m": self.position_rmse,
            **{f"coverage_{100 * p:.0f}": self.coverage(p) for p in PROBABILITIES},
        }
        start = self.overconfident_from
        return {
            "runs": len(self.trials),
            "overconfident_from": "never" if start is None else start,
            **{name: mean.value for name, mean in means.items()},
            **{f"{name}_error": mean.error for name, mean in means.items()},
            "coalescence": self.coalescence,
        }


def run_trials(trial: Callable[[int], Trial], seeds: Sequence[int], workers: int = 1) -> Consistency:
    """Runs a trial once per seed.

    Args:
        trial: a `RobotTrial`, a `DeskTrial` or anything picklable that makes a `Trial` from a seed.
        seeds: one run each.
        workers: processes.
    """
    return Consistency(in_parallel(trial, seeds, workers))


def left_for_good(mean_nees: np.ndarray, high: float) -> int | None:
    """The step at which a mean NEES (T,) leaves its band upwards for good.

    That is the first step above the band such that, for every later step s, at least half of the steps from it to s
    are above the band: single steps inside do not end overconfidence, and single ones outside, one in forty for a
    consistent filter, do not begin it. It must be at least `LAST` steps before the end.

    Returns:
        The step; None for a filter that stays inside or returns.
    """
    votes = np.where(np.nan_to_num(mean_nees, nan=0.0) > high, 1, -1)
    total = np.concatenate([[0], np.cumsum(votes)])
    # the sum of the votes from t to s is total[s + 1] − total[t]; its minimum over s must not be negative
    least = np.minimum.accumulate(total[:0:-1])[::-1]
    starts = np.flatnonzero((votes > 0) & (least >= total[:-1]))
    return int(starts[0]) if starts.size and starts[0] <= mean_nees.size - LAST else None


def _nis_ratio(trial: Trial) -> float:
    used = np.isfinite(trial.nis) & (trial.nis_dof > 0)
    return float(trial.nis[used].sum() / trial.nis_dof[used].sum()) if used.any() else float("nan")


CAMERA, ROBOT = "monocular", "range-bearing"
Trials = dict[str, Callable[[int], Trial]]


def robot_trials(steps: int, particles: tuple[int, ...]) -> tuple[Trials, Trials]:
    """Range-bearing runs by number of particles, and with one thing changed at the middle number."""
    world, base = RobotWorld(steps=steps), RangeBearingConfig(particles=particles[1], map="particles")
    changed = {
        "bootstrap proposal": replace(base, proposal=ProposalConfig(kind="prior")),
        "one linearisation": replace(base, proposal=ProposalConfig(iterations=1)),
        "linearised weights": replace(base, proposal=ProposalConfig(weights="linearised")),
    }
    sizes = {f"{n} particles": RobotTrial(world, RangeBearingConfig(particles=n, map="particles")) for n in particles}
    return sizes, {name: RobotTrial(world, config) for name, config in changed.items()}


def desk_trials(frames: int, particles: tuple[int, ...]) -> tuple[Trials, Trials]:
    """The same for the camera over a desk."""
    world, base = DeskWorld(frames=frames), MonoConfig(particles=particles[1], map="particles")
    changed = {
        "start sampled (known points as landmarks)": replace(base, known="points"),
        "three linearisations": replace(base, proposal=ProposalConfig(iterations=3)),
        "linearised weights": replace(base, proposal=ProposalConfig(weights="linearised", iterations=1)),
        "epipolar constraint": replace(base, inverse_depth=replace(base.inverse_depth, pose_update="epipolar")),
    }
    sizes = {f"{n} particles": DeskTrial(world, MonoConfig(particles=n, map="particles")) for n in particles}
    return sizes, {name: DeskTrial(world, config) for name, config in changed.items()}


def draw_curves(axes: Any, system: str, found: dict[str, Consistency]) -> None:
    """Plots the mean NEES per degree of freedom over time."""
    first = next(iter(found.values()))
    band, dim = first.band(), first.dim
    axes.axhspan(band.low / dim, band.high / dim, color="tab:green", alpha=0.25, label="95 % band, honest filter")
    for name, consistency in found.items():
        start = consistency.overconfident_from
        (line,) = axes.plot(consistency.mean_nees / dim, lw=1.1, label=name)
        if start is not None:
            axes.axvline(start, color=line.get_color(), lw=0.8, ls=":")
    runs = len(first.trials)
    axes.set(title=f"{system}: NEES of the pose, mean of {runs} runs", xlabel="step", ylabel="NEES / d", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def draw_remedies(axes: Any, found: dict[str, Consistency]) -> None:
    """Plots the mean NEES over all steps, with its standard error, for poses and landmarks."""
    places = np.arange(len(found))[::-1]
    for shift, what, colour in ((0.12, "pose_nees", "tab:blue"), (-0.12, "landmark_nees", "tab:red")):
        means = [getattr(consistency, what) for consistency in found.values()]
        values, errors = [mean.value for mean in means], [2.0 * mean.error for mean in means]
        axes.errorbar(values, places + shift, xerr=errors, fmt="o", color=colour, label=what.replace("_nees", "s"))
    axes.axvline(1.0, color="tab:green", lw=1.0)
    axes.set_yticks(places, list(found))
    axes.set(xlabel="NEES / d, ± 2 standard errors", xscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def table_row(system: str, name: str, consistency: Consistency) -> list[str | int | float]:
    """One line of the table."""
    start = consistency.overconfident_from
    return [
        system, name, len(consistency.trials), consistency.pose_nees.value, consistency.landmark_nees.value,
        consistency.nis.value, consistency.coverage(0.5).value, consistency.coverage(0.9).value,
        consistency.coverage(0.95).value, "never" if start is None else start,
        1e3 * consistency.position_rmse.value, consistency.coalescence,
    ]  # fmt: skip


def main(
    runs: int = 50,
    remedies: int = 20,
    steps: int = 150,
    particles: tuple[int, int, int] = (50, 250, 1000),
    workers: int = 2,
    out: Path = Path("demo/consistency_runs"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs everything and prints the table.

    Args:
        runs: number of recordings for each number of particles.
        remedies: number of recordings for each remedy.
        steps: of each recording.
        particles: three numbers of particles; remedies are tried with the middle one.
        workers: processes.
        out: folder for plot and tables.
        quick: few short recordings, few particles.
    """
    if quick:
        runs, remedies, steps, particles, workers = 2, 2, 40, (10, 20, 40), 1
    figure = Figure(figsize=(14.0, 9.0), layout="constrained")
    panels = figure.subplots(2, 2)
    rows, curves = [], dict[str, np.ndarray]()
    systems = {CAMERA: desk_trials(steps, particles), ROBOT: robot_trials(steps, particles)}
    for column, (system, (sizes, changed)) in enumerate(systems.items()):
        found = {name: run_trials(trial, range(runs), workers) for name, trial in sizes.items()}
        middle = f"{particles[1]} particles"
        few = Consistency(found[middle].trials[:remedies])
        tried = {"as it is": few} | {
            name: run_trials(trial, range(remedies), workers) for name, trial in changed.items()
        }
        draw_curves(panels[0, column], system, found)
        draw_remedies(panels[1, column], tried)
        for name, consistency in (found | {f"{middle}, {key}": c for key, c in tried.items()}).items():
            rows.append(table_row(system, name, consistency))
            curves[f"{system}, {name}"] = consistency.mean_nees
    header = [
        "system", "filter", "runs", "poses", "landmarks", "NIS", "in 50 %", "in 90 %", "in 95 %", "over-confident from",
        "error [mm]", "coalescence",
    ]  # fmt: skip
    rows.sort(key=lambda row: str(row[0]))
    write_table(out / "consistency.csv", header, rows)
    steps_of = [[t, *(float(curve[t]) for curve in curves.values())] for t in range(steps)]
    write_table(out / "nees.csv", ["step", *curves], steps_of, shown=False)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "consistency.png", dpi=110)
    print(f"picture and tables in {out}")
    return {f"{row[0]}, {row[1]}": float(row[3]) for row in rows}


if __name__ == "__main__":
    tyro.cli(main)
