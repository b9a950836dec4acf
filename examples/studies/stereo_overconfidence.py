"""Overconfidence of the stereo filter: its causes, and remedies that also improve on odometry.

S05 bounds the weight of a match: −½ min(T_l, d²) with T_l = 4. A quarter of the correct matches exceed the bound. If
these do not update their landmarks either, each particle is updated only by matches that agree with it: its map drifts
with its path, the error is that of the odometry, and the covariance is a tenth of the true one. More particles and
injected noise do not help. The remedy is that T_l bounds only the weight, and landmarks are updated by all matches
within a wide gate.

Pixels of the laboratory of points with Gaussian noise and known association: the path's error, mean over recordings,
and the NEES of the pose, median over all pairs, of which 6 is consistent.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.lab import LabDrive
from examples.studies.point_worlds import STEREO, LabWorld, Measuring, simulate_features
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_features
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig, ResamplingConfig
from rbpf.systems.stereo.config import OUTLIER_VOLUME_PX3, MapConfig, OdometryConfig, StereoConfig, TriggerConfig
from rbpf.validation.consistency.statistic import whitened_errors

DIM = 6
"""Expected NEES of a pose for a consistent filter."""

DEFAULT, CLIPPED = "default: prior, T_l = 4, updates within 16.3", "what is clipped does not update"


class Figures(NamedTuple):
    """Figures of one run: root mean square position errors of the filter and of its odometry; NEES (T,)."""

    error_m: float
    odometry_m: float
    nees: np.ndarray


def variants(particles: int) -> dict[str, StereoConfig]:
    """Variants with one change each."""
    base = replace(StereoConfig.s05(), particles=particles, trigger=TriggerConfig(0.0, 0.0))
    refined = ProposalConfig("ekf", iterations=1)
    clipped = replace(base, likelihood=truncated(4.0, 4.0))
    noisy = OdometryConfig(std_added_rad=2e-4, std_added_m=5e-4)
    density = LikelihoodConfig("outliers", outlier_volume=OUTLIER_VOLUME_PX3)
    return {
        DEFAULT: base,
        CLIPPED: clipped,
        "… with four times the particles": replace(clipped, particles=4 * particles),
        "… with injected noise of 0.5 mm and 0.2 mrad": replace(clipped, odometry=noisy),
        "… with T_l = 9": replace(base, likelihood=truncated(9.0, 9.0)),
        "T_l = 9, updates within 16.3": replace(base, likelihood=truncated(9.0, 16.3)),
        "four times the particles": replace(base, particles=4 * particles),
        "injected noise of 0.5 mm and 0.2 mrad": replace(base, odometry=noisy),
        "resampling below 0.1 N": replace(base, resampling=ResamplingConfig(ess_threshold=0.1)),
        "prior, density with outliers": replace(base, likelihood=density),
        "refined, T_l = 4, updates within 16.3": replace(base, proposal=refined),
        "refined, density with outliers": replace(base, proposal=refined, likelihood=density),
        "the odometry as proposal, density with outliers": replace(
            base,
            proposal=ProposalConfig("ekf"),
            likelihood=density,
            odometry=OdometryConfig(role="proposal"),
            map=MapConfig(kind="particles", weigh="all"),
        ),
    }


def truncated(limit: float, update_limit: float) -> LikelihoodConfig:
    """S05's likelihood."""
    return LikelihoodConfig("truncated", limit, update_limit=update_limit, outlier_volume=OUTLIER_VOLUME_PX3)


def figures_of(log: FeatureLog, config: StereoConfig) -> Figures:
    """Figures of one run."""
    run = filter_features(log, config)
    assert run.truth is not None
    true, poses = run.truth.poses, run.log.poses

    def error(path: np.ndarray) -> float:
        off = SE3.translation(path) - SE3.translation(true)
        return float(np.sqrt(np.square(off).sum(axis=1).mean()))

    # At the start the pose is known exactly.
    nees = whitened_errors(SE3, poses[1:], run.log.covs[1:], true[1:]).nees
    return Figures(error(poses), error(run.log["odometry"]), nees)


def main(
    out: Path = Path("stereo_overconfidence"),
    particles: int = 400,
    seeds: int = 4,
    frames: int = 60,
    every: int = 4,
    noise_px: float = 0.3,
    quick: bool = False,
) -> dict[str, float]:
    """Runs every variant on every recording.

    Args:
        out: folder for the table.
        particles: number of particles.
        seeds: number of recordings.
        frames: pairs of each.
        every: every n-th frame of the robot's drive is a pair.
        noise_px: of the pixels.
        quick: one recording, a third of the pairs and few particles, as a check.
    """
    if quick:
        seeds, frames, particles = 1, 20, 100
    world = LabWorld(LabDrive(frames=frames, every=every), points=8000)
    measuring = Measuring(noise_px=noise_px, measurements=40, known=0, new_per_frame=20)
    logs = [simulate_features(world, measuring, STEREO, seed) for seed in range(seeds)]
    rows: list[list[str | float]] = []
    results = {}
    for name, config in variants(particles).items():
        runs = [figures_of(log, config) for log in logs]
        error = 1e3 * float(np.mean([run.error_m for run in runs]))
        nees = float(np.median(np.concatenate([run.nees for run in runs])))
        rows.append([name, error, nees])
        results |= {f"{name}: error, mm": error, f"{name}: NEES": nees}
    results["odometry alone: error, mm"] = 1e3 * float(np.mean([run.odometry_m for run in runs]))
    rows.append(["odometry alone", results["odometry alone: error, mm"], ""])
    write_table(out / "table.csv", ["variant", "error mm", "median NEES"], rows)
    draw(rows[:-1], results["odometry alone: error, mm"], out / "table.png")
    return results


def draw(rows: list[list[str | float]], odometry_mm: float, file: Path) -> None:
    """Plots error and NEES of the variants, with the odometry's error and the expected NEES."""
    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    names = [str(row[0]) for row in rows][::-1]
    sides = zip(figure.subplots(1, 2, sharey=True), ("error, mm", "median NEES"), strict=True)
    for column, (axes, what) in enumerate(sides, start=1):
        axes.barh(names, [float(row[column]) for row in rows][::-1])
        right = odometry_mm if column == 1 else DIM
        axes.axvline(right, color="black", ls="--", label="odometry alone" if column == 1 else "right")
        axes.set(xlabel=what)
        axes.legend(fontsize="small")
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
