"""Model comparison of two configurations on the same data: difference of log-evidences, with its error.

A particle filter's evidence Ẑ is random. With many particles log Ẑ is nearly N(log Z − σ²/2, σ²) (J. Bérard, P. Del
Moral, A. Doucet, "A lognormal central limit theorem for particle approximations of normalizing constants", 2014), so
that from S seeds with mean m and variance s² of log Ẑ

    log Z ≈ m + s²/2,   with variance  s²/S + s⁴ / (2 (S − 1))

This approximation fails for large s: then log Z is the logarithm of the mean of Ẑ, which a single seed may dominate, with the
error s.

If a robot's landmarks are named and its likelihood is Gaussian, the filter's model is the batch's, and Ẑ is from draws of the
batch posterior (`rbpf.validation.gtsam.path_sampling`), one part of them per seed: more precise by orders of magnitude than
with particles, and in one pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbpf.core.likelihoods import Gaussian
from rbpf.errors import InputError
from rbpf.runs.files import OnDone
from rbpf.runs.reading import RunFolder
from rbpf.runs.recordings import RobotRecording, filter_features, filter_recording
from rbpf.runs.run import Run
from rbpf.sensors.feature_log import FeatureLog
from rbpf.sensors.readers import Part
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import load_settings
from rbpf.systems.stereo.config import StereoConfig

NOISY = 3.0  #: Spread s of log Ẑ over the seeds beyond which its distribution is not used.
CLEAR = 2.0  #: A difference of this many standard errors is significant.
Config = RangeBearingConfig | MonoConfig | StereoConfig
Data = RobotRecording | FeatureLog


@dataclass(frozen=True)
class EvidenceDifference:
    """Log-evidences of two configurations on the same data, in nats."""

    log_evidence_a: float  #: of the first;  log_evidence_b: of the second.
    log_evidence_b: float
    error: float  #: standard error of the difference by the filters' randomness.
    spread: float  #: larger standard deviation of log Ẑ over the seeds; beyond `NOISY` more particles are needed.

    @property
    def difference(self) -> float:
        """First minus second: log of the Bayes factor."""
        return self.log_evidence_a - self.log_evidence_b

    def sentence(self, name_a: str, name_b: str) -> str:
        """The result in words."""
        difference, error = self.difference, self.error
        better, worse = (name_a, name_b) if difference > 0.0 else (name_b, name_a)
        both = f"log-evidence {self.log_evidence_a:.1f} against {self.log_evidence_b:.1f}"
        found = f"{both}, difference {difference:.1f} ± {error:.2g}"
        if abs(difference) <= CLEAR * error:
            if self.spread > NOISY:
                return f"Too random to tell ({found}, {self.spread:.1f} from seed to seed): use more particles."
            return f"{name_a} and {name_b} explain the recording equally well ({found})."
        return f"{better} explains the recording better than {worse} ({found})."


def evidence_difference(logs_a: Sequence[float], logs_b: Sequence[float]) -> EvidenceDifference:
    """From log-evidences of any filters, one per seed. Raises InputError: fewer than two, or NaN."""
    pair = np.asarray(logs_a, dtype=float), np.asarray(logs_b, dtype=float)
    for name, logs in zip(("first", "second"), pair, strict=True):
        if logs.size < 2:
            raise InputError("log-evidences are compared over 2 seeds or more, which tell their error")
        if not np.isfinite(logs).all():
            raise InputError(
                f"the {name} filter has no evidence: one of its likelihoods is not a density, or some observations updated "
                "only the particles or only the map"
            )
    (a, error_a), (b, error_b) = map(_log_evidence, pair)
    spread = float(max(logs.std(ddof=1) for logs in pair))
    return EvidenceDifference(a, b, float(np.hypot(error_a, error_b)), spread)


def compare_evidence(
    config_a: Config, config_b: Config, data: Data, seeds: Sequence[int], workers: int = 1, on_run: OnDone | None = None
) -> EvidenceDifference:
    """Compares how two configurations of one system explain the same data: filtered once per seed, or in batch.

    Their own seeds are not used; `seeds` are two or more. `workers` are processes, −1 for one per core. `on_run` is
    called with the runs done and their number; not in batch.

    Raises InputError: the configurations are of different systems, differ in the data used, do not fit the data, or one
    has no evidence: its likelihood is not normalised, or measurements are not counted exactly once.
    """
    from joblib import Parallel, delayed

    if type(config_a) is not type(config_b):
        raise InputError("two configurations of different systems do not explain the same data: compare two of one")
    if isinstance(data, FeatureLog) == isinstance(config_a, RangeBearingConfig):
        raise InputError(f"a {type(config_a).__name__} does not filter a {type(data).__name__}")
    if len(seeds) < 2:
        raise InputError(f"log-evidences are compared over 2 seeds or more, got {len(seeds)}")
    # Landmark names must be given equally to both, and measurements counted once.
    for name, config in (("first", config_a), ("second", config_b)):
        if not isinstance(config, MonoConfig) and not config.likelihood.build().normalised:
            raise InputError(
                f"the {name} configuration has no evidence: its likelihood {config.likelihood.kind!r} is not a density "
                "(it does not integrate to one); use gaussian, or outliers for observations that may be wrong"
            )
        if isinstance(config, MonoConfig) and config.max_new_per_frame > 0:
            raise InputError(
                "a monocular filter that starts features has no evidence: of one whose depth is unknown, the pose and the "
                "depth are told different parts of a measurement, and a first sighting counts nothing, so that who starts "
                "fewer explains more; set max_new_per_frame to 0 in both configurations, on a log with known points"
            )
    if getattr(config_a, "association", None) != getattr(config_b, "association", None):
        raise InputError(
            "a filter that is given the landmarks' names and one that is not do not explain the same data: set the "
            "same association in both configurations"
        )
    # Stereo odometry is an input, not part of the evidence: it must be equal in both.
    if isinstance(config_a, StereoConfig) and isinstance(config_b, StereoConfig):
        if config_a.odometry.split != "apart" or config_b.odometry.split != "apart":
            raise InputError(
                "by default stereo odometry moves the particles by the very pixels that the map then explains, so that "
                "an evidence would count them twice; set odometry.split to apart in both configurations"
            )
        for name in ("odometry", "trigger", "dof"):
            if getattr(config_a, name) != getattr(config_b, name):
                raise InputError(
                    f"two stereo configurations that differ in {name} do not explain the same data: what odometry says "
                    "is given to the filter, and differs between them"
                )
    in_batch = _in_batch(config_a, data, len(seeds)), _in_batch(config_b, data, len(seeds))
    if in_batch[0] and in_batch[1]:
        return evidence_difference(*in_batch)
    jobs = [(replace(config, seed=seed), data) for config in (config_a, config_b) for seed in seeds]
    logs: list[float] = []
    for value in Parallel(n_jobs=workers, return_as="generator")(delayed(_evidence)(*job) for job in jobs):
        logs.append(value)
        if on_run is not None:
            on_run(len(logs), len(jobs))
    return evidence_difference(logs[: len(seeds)], logs[len(seeds) :])


def compare_runs(
    run_a: Path, run_b: Path, seeds: int = 5, workers: int = 1, on_run: OnDone | None = None
) -> EvidenceDifference:
    """The same for the settings of two finished runs over one recording, which are repeated with several seeds.

    Raises InputError: they are runs of different systems or recordings, or of images, or have no evidence.
    """
    records = RunFolder.open(run_a), RunFolder.open(run_b)
    for record in records:
        if record.system in ("mono", "stereo"):
            raise InputError(
                f"{record.folder}: what is measured in images depends on where the filter looks for it, so that two "
                "settings do not explain the same data; compare them on a FeatureLog by compare_evidence"
            )
        if record.system != "range-bearing":
            raise InputError(f"{record.folder}: runs of the system {record.system!r} cannot be compared by evidence")
    one, other = (RobotRecording(Path(str(record.config["recording"])), Part.of(record.config)) for record in records)
    if one != other:
        raise InputError(
            f"{run_a} and {run_b} are runs over different recordings, or parts of one: evidences say nothing about them"
        )
    files = [record.folder / "config.yaml" for record in records]
    configs = [load_settings(RangeBearingConfig, "range-bearing", file, (), {}) for file in files]
    return compare_evidence(configs[0], configs[1], one, range(seeds), workers, on_run)


def _log_evidence(logs: np.ndarray) -> tuple[float, float]:
    """Estimate and its standard error."""
    variance = float(logs.var(ddof=1))
    if variance > NOISY**2:
        return float(np.logaddexp.reduce(logs)) - float(np.log(logs.size)), float(np.sqrt(variance))
    error = np.sqrt(variance / logs.size + variance**2 / (2.0 * (logs.size - 1)))
    return float(logs.mean()) + 0.5 * variance, float(error)


def _in_batch(config: Config, data: Data, parts: int) -> list[float]:
    """Log-evidences by parts of the draws from a robot's batch posterior; none if the filter's model is not the batch's."""
    from rbpf.validation.gtsam.batch_problem import solve_problem
    from rbpf.validation.gtsam.path_sampling import draw_posterior

    if isinstance(data, FeatureLog) or not isinstance(config, RangeBearingConfig) or config.association != "known":
        return []
    run = _filtered(replace(config, particles=1), data)
    if not isinstance(run.system.likelihood, Gaussian):
        return []
    problem = run.system.measurements(run.name, run.log)
    optimum = solve_problem(problem, run.log.poses, marginals=False)
    draws = draw_posterior(problem, optimum.start, np.random.default_rng(0))
    logs = np.array_split(draws.log_ratio, parts)
    return [float(np.logaddexp.reduce(part) - np.log(part.size)) for part in logs]


def _filtered(config: Any, data: Data) -> Run[Any]:
    return filter_features(data, config) if isinstance(data, FeatureLog) else filter_recording(data, config)


def _evidence(config: Config, data: Data) -> float:
    if isinstance(config, RangeBearingConfig):
        # A landmark re-initialised by a sub-map would count as new: use the evidence of one joint Gaussian.
        config = replace(config, submap=None)
    return float(_filtered(config, data).system.filter.log_evidence)
