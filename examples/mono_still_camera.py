"""What do landmarks without depth say about the camera? (E06, figure 9)

A camera at rest sees four known points, the corners of a small tilted square three metres away, and sixteen other
points whose depth it cannot find out because it does not move. The corners alone leave the camera uncertain: turning
round the square and going sideways look nearly the same. The other points do not tell where the camera is, but they
tell that it has not moved since it first saw them: their distance from the epipolar line must be zero.

The table compares three treatments of the points without depth: not used ("off"), the epipolar constraint of the paper,
and the whole 2-D measurement with depth marginalised. It has the volume of the pose covariance, √|P|, of all six
numbers and of the three of position, relative to "off" that stays off; the cube root of the latter as a standard
deviation; and the normalised error (NEES, 6 is honest), without which a small cloud says nothing. Two ways of starting
are compared: the paper's, where each particle samples its first pose and the cloud ends up small and wrong, and the
marginalised frame of the known points.

Where a ray may become a point, "off" does not stay off: the uncertain camera seems to move, a depth that fits is found,
and the point constrains the pose from then on. The last rows show it, with how many rays are left.

The picture has the first recording's clouds seen from above, for rays that stay rays: camera positions drawn from the
posterior; the cross is the truth. The square is to the right, at x = 3 m.
"""

from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.maps.inverse_depth import InverseDepth
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig
from rbpf.systems.mono.run import run
from rbpf.validation.consistency.pose_errors import pose_errors
from rbpf.validation.e06.still_camera import camera_cloud
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import PlanarTargetWorld
from rbpf.validation.sweep.parallel import in_parallel
from rbpf.validation.tables import write_table

TREATMENTS = ("off", "epipolar", "marginal")
NEVER = 1e-6  # ready_ratio of rays that stay rays
KINDS = {"stay rays": NEVER, "become points": InverseDepthConfig().promote_std_ratio}
STARTS = {"points": "sampled (E06)", "frame": "marginalised"}


class Job(NamedTuple):
    """One run."""

    kind: str
    known: str
    treatment: str
    seed: int
    frames: int
    particles: int


class Posterior(NamedTuple):
    """Of the last frame: log volumes of pose and position, NEES, number of rays left, camera positions (N, 3)."""

    log_pose: float
    log_position: float
    nees: float
    rays: int
    cloud: np.ndarray


def filtered(job: Job) -> Posterior:
    """Simulates and filters."""
    log = simulate_features(PlanarTargetWorld(frames=job.frames), Measuring(turnover=0.0), MONO, job.seed)
    ray = InverseDepthConfig(pose_update=job.treatment, promote_std_ratio=KINDS[job.kind])
    done = run(log, MonoConfig(particles=job.particles, seed=job.seed, known=job.known, inverse_depth=ray))
    cov = done.cov[-1:]
    errors = pose_errors(done.world_from_camera[-1:], cov, log.truth.world_from_camera[-1:])
    volumes = [0.5 * float(np.linalg.slogdet(part)[1]) for part in (cov[0], cov[0, 3:, 3:])]
    landmark_map = done.filter.belief().map
    rays = int(landmark_map.are(landmark_map.ids, InverseDepth(ray.promote_std_ratio)).sum())
    return Posterior(
        *volumes, float(errors.nees[0]), rays, camera_cloud(done.filter, np.random.default_rng(job.seed))
    )


def draw(clouds: dict[tuple[str, str], np.ndarray], path: Path) -> None:
    """Camera positions (N, 3) by start and treatment."""
    figure = Figure(figsize=(11.0, 7.6), layout="constrained")
    rows = figure.subplots(len(STARTS), len(TREATMENTS), sharex=True, sharey=True)
    for axes, (known, treatment) in zip(rows.flat, product(STARTS, TREATMENTS), strict=True):
        axes.plot(*clouds[known, treatment][:, :2].T, ".", ms=4, alpha=0.5, color="tab:blue")
        axes.plot(0.0, 0.0, "x", color="black", ms=10, mew=2)
        axes.set(
            title=f"{treatment}; start {STARTS[known]}", xlim=(-0.6, 0.6), ylim=(-0.8, 0.4), aspect="equal"
        )
        axes.grid(alpha=0.3)
    for axes in rows[-1]:
        axes.set_xlabel("x [m], towards the square")
    for axes in rows[:, 0]:
        axes.set_ylabel("y [m]")
    figure.savefig(path, dpi=110)


def main(
    seeds: int = 10,
    particles: int = 500,
    workers: int = 2,
    out: Path = Path("demo/mono_still_camera"),
    quick: bool = False,
) -> dict[str, float]:
    """Filters with and without the constraint; prints the ratio of the volumes.

    Args:
        seeds: number of recordings.
        particles: of each filter.
        workers: processes.
        out: folder for picture and table.
        quick: two short recordings and few particles.
    """
    frames, particles = (20, 100) if quick else (60, particles)
    seeds, workers = (2, 1) if quick else (seeds, workers)
    keys = list(product(KINDS, STARTS, TREATMENTS))
    jobs = [Job(*key, seed, frames, particles) for key in keys for seed in range(seeds)]
    done = in_parallel(filtered, jobs, workers)
    found = {key: done[k * seeds : (k + 1) * seeds] for k, key in enumerate(keys)}

    rows, figures = [], {}
    for kind, known, treatment in keys:
        here, off = (
            np.array([p[:4] for p in found[key]])
            for key in ((kind, known, treatment), (keys[0][0], known, "off"))
        )
        pose, position = np.exp((here - off)[:, :2].mean(axis=0)).tolist()
        sigma_mm = 1e3 * float(np.exp(here[:, 1].mean() / 3.0))
        nees, rays = np.median(here[:, 2]), here[:, 3].mean()
        rows.append([kind, STARTS[known], treatment, pose, position, sigma_mm, float(nees), float(rays)])
        figures[f"{treatment} / {known} / {kind}"] = pose
    header = ["rays", "start", "treatment", "pose volume", "position", "σ [mm]", "NEES, median", "rays left"]
    write_table(out / "volumes.csv", header, rows)
    clouds = {
        (known, treatment): found[keys[0][0], known, treatment][0].cloud for _, known, treatment in keys
    }
    draw(clouds, out / "mono_still_camera.png")
    print(f"picture and table in {out}")
    return figures


if __name__ == "__main__":
    tyro.cli(main)
