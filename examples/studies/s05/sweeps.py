"""Parameters left open by S05: the number of particles and the injected noise; and the likelihood."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from examples.studies.feature_cache import CachedSequence, filter_cached
from examples.studies.s05.record import rms
from rbpf.lie import SE3
from rbpf.runs.run import Run
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.consistency.statistic import whitened_errors

ERROR, NEES = ("error m", "least", "most"), ("median NEES", "least NEES", "most NEES")
HEADER = ("setting", *ERROR, "at the end m", *NEES, "right", "s per pair")

PARTICLES = 100, 1600
NOISE = (1e-3, 5e-4), (5e-3, 2e-3)
"""Noise injected per update: m, rad."""


def settings(base: StereoConfig) -> dict[str, StereoConfig]:
    """Settings with one change each."""
    outliers = replace(base.likelihood, kind="outliers")
    refined = ProposalConfig("ekf", iterations=1)
    clipped = LikelihoodConfig("truncated", update_limit=base.likelihood.truncation)
    out = {"as it is": base}
    out |= {f"{n} particles": replace(base, particles=n) for n in PARTICLES}
    for shift, turn in NOISE:
        noisy = replace(base.odometry, std_added_m=shift, std_added_rad=turn)
        out[f"injected {1e3 * shift:g} mm, {1e3 * turn:g} mrad"] = replace(base, odometry=noisy)
    out["what is clipped does not update"] = replace(base, likelihood=clipped)
    out["density with outliers"] = replace(base, likelihood=outliers)
    out["refined, density with outliers"] = replace(base, likelihood=outliers, proposal=refined)
    out["6 degrees of freedom"] = replace(base, dof=6)
    return out


def sweep(drive: CachedSequence, base: StereoConfig, seeds: Sequence[int] = (0,)) -> Iterator[list[str | float]]:
    """A row per setting, and one for odometry alone: median, minimum and maximum over the filter's seeds."""
    for name, config in settings(base).items():
        runs = [filter_cached(drive, replace(config, seed=seed)) for seed in seeds]
        off, end, nees, right, seconds = np.array([figures_of(run) for run in runs]).T
        middle = float(np.median(end)), float(np.median(seconds))
        yield [name, *_spread(off), middle[0], *_spread(nees), float(right[0]), middle[1]]
        if config == base:
            off, end = np.array([_off(run, run.log["odometry"]) for run in runs]).T
            yield ["odometry alone", *_spread(off), float(np.median(end)), "", "", "", "", ""]


def figures_of(run: Run) -> Sequence[float]:
    """Error of the path and of its end, median NEES of the pose, its expected value, wall-clock seconds."""
    log, truth = run.log, run.truth
    assert truth is not None
    rows = truth.rows[1:]
    errors = whitened_errors(SE3, log.poses[rows], log.covs[rows], truth.poses[1:])
    nees, rank = float(np.median(errors.nees)), float(np.median(errors.ranks))
    return [*_off(run, log.poses), nees, rank, float(log["seconds"].mean())]


def _off(run: Run, path: np.ndarray) -> Sequence[float]:
    truth = run.truth
    assert truth is not None
    off = SE3.translation(path[truth.rows]) - SE3.translation(truth.poses)
    return [rms(off), float(np.linalg.norm(off[-1]))]


def _spread(values: np.ndarray) -> Sequence[float]:
    return [float(np.median(values)), float(values.min()), float(values.max())]
