"""Figure 9: information of landmarks without depth about a camera at rest that observes four points of a plane."""

from typing import Any, NamedTuple

import numpy as np

from examples.studies.e06.setting import Row, Setting, true_poses
from examples.studies.e06.worlds import StillTarget
from rbpf.core.filter import Filter
from rbpf.lie import SE3
from rbpf.runs.plots import save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig
from rbpf.systems.mono.start.known import world_of
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.simulation.images import Imaging

TREATMENTS = {"off": "four points alone", "epipolar": "epipolar constraint", "marginal": "2-D marginal"}
NEVER = 1e-6
"""`promote_std_ratio` with which rays are never promoted, as the camera does not move."""
KNOWN_STD_M = 0.001


class Posterior(NamedTuple):
    """Posterior of the last frame: volumes √|P| of pose and position, NEES of the pose, camera positions (N, 3)."""

    pose: float
    position: float
    nees: float
    cloud: np.ndarray


def camera_cloud(filter_: Filter, rng: np.random.Generator) -> np.ndarray:
    """Camera positions (N, 3) in the world of the known points, sampled from the posterior."""
    particles, world = filter_.particles, world_of(filter_)
    rows = rng.choice(filter_.n, filter_.n, p=particles.weights)
    poses = particles.state[rows, :7]
    if world is not None:
        noise = np.einsum("nab,nb->na", world.factor[rows], rng.normal(size=(filter_.n, 6)))
        poses = SE3.between(SE3.retract(world.mean[rows], noise), poses)
    return SE3.translation(poses)


def reproduce(setting: Setting) -> list[Row]:
    """Filters the same images with each treatment."""
    world = StillTarget(frames=15 if setting.quick else 60)
    sequence, _ = setting.sequence("still", world, Imaging(known=0))
    rng = np.random.default_rng(setting.seed)
    known = world.known(setting.camera, KNOWN_STD_M, setting.config().search.noise_px, rng)
    truth = true_poses(sequence)[-1:]
    found = {}
    for treatment in TREATMENTS:
        ray = InverseDepthConfig(pose_update=treatment, promote_std_ratio=NEVER)  # type: ignore[arg-type]
        config = MonoConfig(particles=setting.particles, seed=setting.seed, inverse_depth=ray, map="particles")
        run = filter_opened(open_mono(sequence, config, known))
        errors = whitened_errors(SE3, run.log.poses[-1:], run.log.covs[-1:], truth)
        pose, position = (np.sqrt(np.linalg.det(part)) for part in (run.log.covs[-1], run.log.covs[-1, 3:, 3:]))
        cloud = camera_cloud(run.system.filter, np.random.default_rng(setting.seed))
        found[treatment] = Posterior(float(pose), float(position), float(errors.nees[0]), cloud)
    save_figures({"figure_9.png": _draw(found, SE3.translation(truth)[0])}, setting.out)
    return [_row(found, treatment) for treatment in ("epipolar", "marginal")]


def _row(found: dict[str, Posterior], treatment: str) -> Row:
    off, here = found["off"], found[treatment]
    fraction = here.pose / off.pose
    sigma = [1e3 * np.cbrt(one.position) for one in (off, here)]
    ours = (
        f"pose volume x {fraction:.2g}; σ {sigma[0]:.0f} to {sigma[1]:.0f} mm; NEES {off.nees:.1f} and {here.nees:.1f}"
    )
    return Row("Fig. 9", f"camera at rest, {TREATMENTS[treatment]} against none", "far better constrained", ours, fraction,
               fraction < 0.5)  # fmt: skip


def _draw(found: dict[str, Posterior], truth: np.ndarray) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.5), layout="constrained")
    panels = figure.subplots(1, len(found), sharex=True, sharey=True)
    half = 1.05 * max(float(np.abs(one.cloud - truth)[:, :2].max()) for one in found.values())
    for axes, (treatment, one) in zip(panels, found.items(), strict=True):
        axes.plot(*(one.cloud - truth)[:, :2].T, ".", ms=4, alpha=0.5)
        axes.plot(0.0, 0.0, "x", color="black", ms=10, mew=2)
        axes.set(
            title=f"{TREATMENTS[treatment]} (Fig. 9)",
            xlabel="x [m], towards the poster",
            xlim=(-half, half),
            ylim=(-half, half),
            aspect="equal",
        )
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("y [m], to the left")
    return figure
