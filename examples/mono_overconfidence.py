"""Why is a particle filter for a camera over-confident, and what cures it?

E06 starts from four points of known structure. Taken literally (known = "points"), each particle samples its first pose
from what these say in the first frame, which is a centimetre and a degree. It maps everything from there. Later
frames tell the first pose several times better; no particle can go back and correct it, and resampling keeps the few
that happened to be near. So the particles contradict what they see, agree with each other, and the normalised error
(NEES, 6 is honest) grows while the error does not shrink.

That it is the start is what the table shows. Given the true first pose, the same filter has a quarter of that NEES;
on a map known within a millimetre, where the start does not matter, it is honest. A map known within a centimetre does
not help: it is not the unknown depths. Neither do other weights, linearisations, constraints, thresholds, velocities,
or four times the particles. Where the frame of the known points is a landmark that every particle marginalises (known =
"frame"), the default is honest over these frames, and with most variants nearly so. What it does not cure: rays that do
not constrain the pose, too few particles, and a prior of inverse depth wider than its mean, with which a recording may
be lost altogether (last column).

Left picture: NEES over time, mean of the recordings, with the band that an honest filter keeps in 95 % of the frames.
Right picture: every variant with the start sampled (red) and marginalised (blue); 5000 stands for that or more.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from rbpf.core.diagnostics import chi_square_band
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.feature_log import FeatureLog, KnownPoints
from rbpf.systems.filtering import ProposalConfig, ResamplingConfig
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig, VelocityConfig
from rbpf.systems.mono.run import pose_estimate
from rbpf.systems.mono.system import build_filter, start_prior
from rbpf.validation.consistency.pose_errors import PoseErrors, pose_errors
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.sweep.parallel import in_parallel
from rbpf.validation.tables import write_csv, write_table

DEFAULT, MORE, TRUE_START = "default", "four times the particles", "true first pose"
SURVEYED = {"all landmarks known within 1 cm": 0.01, "all landmarks known within 1 mm": 0.001}
TICKS = (3, 6, 10, 20, 50, 100, 200, 1000, 5000)
LATE = 50  # frames after which the start is long past


def variants(particles: int) -> dict[str, MonoConfig]:
    """What is changed, one thing at a time."""
    base = MonoConfig(particles=particles)
    ray, one = base.ray, base.proposal
    return {
        DEFAULT: base,
        "linearised weights": replace(base, proposal=replace(one, weights="linearised")),
        "three linearisations": replace(base, proposal=ProposalConfig(iterations=3)),
        "epipolar constraint": replace(base, ray=replace(ray, constrain="epipolar")),
        "rays do not constrain": replace(base, ray=replace(ray, constrain="off")),
        "twice the σ of inverse depth": replace(
            base, inverse_depth=InverseDepthConfig(std_per_m=2.0 * ray.std_per_m)
        ),
        "inverse depth 0.8 ± 0.4": replace(
            base, inverse_depth=InverseDepthConfig(std_per_m=0.4, from_scene_depth=False)
        ),
        "resampling below 0.1 N": replace(base, resampling=ResamplingConfig(ess_threshold=0.1)),
        "resampling below 0.7 N": replace(base, resampling=ResamplingConfig(ess_threshold=0.7)),
        "velocity sampled": replace(base, velocity=VelocityConfig(mode="joint")),
        "velocity of the paper": replace(base, velocity=VelocityConfig(mode="paper")),
        "a fifth of the particles": replace(base, particles=max(particles // 5, 1)),
        MORE: replace(base, particles=4 * particles),
    }


class Job(NamedTuple):
    """One run."""

    name: str
    config: MonoConfig
    seed: int
    frames: int


def errors_of(job: Job) -> PoseErrors:
    """Simulates and filters; a control knows the true start, or the whole map."""
    log = simulate_features(DeskWorld(frames=job.frames), Measuring(), MONO, job.seed)
    start = start_prior(log, job.config)
    if job.name == TRUE_START:
        start = PosePrior(log.truth.world_from_camera[0], np.zeros((6, 6)))
    if job.name in SURVEYED:
        log = replace(log, known=surveyed(log, SURVEYED[job.name], np.random.default_rng(job.seed)))
    filter_, estimates = build_filter(log, job.config), []
    for t, frame in enumerate(log.frames):
        report = filter_.step(frame, start if t == 0 else None, frame.stamp_ns)
        estimates.append(pose_estimate(filter_, report))
    mean, cov = zip(*((e.mean, e.cov) for e in estimates), strict=True)
    return pose_errors(np.array(mean), np.array(cov), log.truth.world_from_camera)


def surveyed(log: FeatureLog, std_m: float, rng: np.random.Generator) -> KnownPoints:
    """Every landmark, with an error of its own."""
    names = np.array(list(log.truth.landmarks), dtype=np.int64)
    positions = np.array(list(log.truth.landmarks.values()))
    cov = np.tile(std_m**2 * np.eye(3), (names.size, 1, 1))
    return KnownPoints(names, positions + std_m * rng.normal(size=positions.shape), cov)


def windows(nees: np.ndarray) -> list[float]:
    """Median over the frames before the 10th, before the 50th and after it."""
    return [float(np.median(part)) for part in np.split(nees, [10, LATE])]


def draw(curves: dict[tuple[str, str], np.ndarray], seeds: int, path: Path) -> None:
    """NEES (T,) by variant and way of starting."""
    figure = Figure(figsize=(13.0, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    band = chi_square_band(6, seeds)
    left.axhspan(band.low, band.high, color="tab:green", alpha=0.25, label="95 % band of an honest filter")
    shown = {
        (DEFAULT, "points"): ("start sampled (E06)", "tab:red"),
        (MORE, "points"): ("start sampled, four times the particles", "tab:orange"),
        (TRUE_START, "points"): ("true first pose given", "tab:purple"),
        (list(SURVEYED)[1], "points"): ("all landmarks known within 1 mm", "tab:brown"),
        (DEFAULT, "frame"): ("frame of the known points marginalised", "tab:blue"),
    }
    for key, (label, colour) in shown.items():
        left.plot(curves[key], color=colour, lw=1.0, label=label)
    left.set(
        title=f"NEES of the pose, mean of {seeds} recordings", xlabel="frame", ylabel="NEES", yscale="log"
    )
    left.legend(fontsize="x-small", loc="upper left", ncols=2)
    names = list(dict.fromkeys(name for name, _ in reversed(curves)))
    ways = {"points": ("start sampled", "tab:red"), "frame": ("marginalised", "tab:blue")}
    for known, (label, colour) in ways.items():
        place = [k for k, name in enumerate(names) if (name, known) in curves]
        late = [min(windows(curves[names[k], known])[2], TICKS[-1]) for k in place]
        right.plot(late, place, "o", color=colour, label=label)
    right.axvline(band.expected, color="tab:green", lw=1.0)
    right.set(title=f"the same after frame {LATE}, median over the frames", xlabel="NEES", xscale="log")
    for axis in (left.yaxis, right.xaxis):
        axis.set_ticks(TICKS, [str(tick) for tick in TICKS])
        axis.set_minor_formatter(NullFormatter())
    left.set_ylim(2.0, 4.0 * curves[DEFAULT, "points"].max())
    right.set_yticks(range(len(names)), names)
    right.grid(alpha=0.3)
    right.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main(
    seeds: int = 5,
    frames: int = 300,
    workers: int = 2,
    out: Path = Path("demo/mono_overconfidence"),
    quick: bool = False,
) -> dict[str, float]:
    """Runs every variant and prints the table.

    Args:
        seeds: number of recordings.
        frames: of each recording.
        workers: processes.
        out: folder for picture and tables.
        quick: one variant and the controls, two short recordings and few particles.
    """
    seeds, frames, workers = (2, 70, 1) if quick else (seeds, frames, workers)
    configs = variants(20 if quick else 250)
    if quick:
        configs = {name: configs[name] for name in (DEFAULT, MORE)}
    keys = [*product(configs, ("points", "frame")), *((name, "points") for name in (TRUE_START, *SURVEYED))]
    jobs = [
        Job(name, replace(configs.get(name, configs[DEFAULT]), known=known, seed=seed), seed, frames)
        for name, known in keys
        for seed in range(seeds)
    ]
    done = in_parallel(errors_of, jobs, workers)
    errors = {key: done[k * seeds : (k + 1) * seeds] for k, key in enumerate(keys)}
    curves = {key: np.mean([e.nees for e in of_key], axis=0) for key, of_key in errors.items()}
    millimetres = {key: 1e3 * float(np.mean([e.rmse for e in of_key])) for key, of_key in errors.items()}

    print(
        f"known points: a sampled start, or a marginalised frame. NEES before frames 10, {LATE}, and after it"
    )
    header = ["changed", "start", "NEES < 10", f"< {LATE}", "after", "error [mm]", "worst after"]
    ways = {"points": "sampled", "frame": "marginalised"}
    worst = {key: max(windows(e.nees)[2] for e in of_key) for key, of_key in errors.items()}
    rows = [[key[0], ways[key[1]], *windows(curves[key]), millimetres[key], worst[key]] for key in keys]
    write_table(out / "variants.csv", header, rows)
    columns = [" / ".join(key) for key in keys]
    write_csv(
        out / "nees.csv",
        ["frame", *columns],
        [[t, *(float(curves[key][t]) for key in keys)] for t in range(frames)],
    )
    draw(curves, seeds, out / "mono_overconfidence.png")
    print(f"picture and tables in {out}")
    return {" / ".join(key): windows(curves[key])[2] for key in keys}


if __name__ == "__main__":
    tyro.cli(main)
