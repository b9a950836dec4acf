"""A camera is carried round the core of a building, and down a corridor (E06, figures 5 and 6).

In the loop the first landmarks come back after most of a lap; nobody tells the filter, it only recognises them by name.
In the corridor nothing ever comes back, so that the error can only grow. The paths start from four known points. A
prior of the inverse depth that fits a desk (0.8 ± 0.4 per metre) does not fit a room (0.15 … 0.6): all landmarks
are off in the same direction, and together they bend the scale of the whole map. The table has this prior, one that
fits a room, and the default, which adapts to depths just seen, with one and three linearisations; and the batch.

For the loop it also has what happens when it closes: the error just before the first landmarks come back and two
seconds after, with the filter's own σ, how many ancestors the particles have one second earlier, and how many seconds
ago they had a single one. It is seconds, the lap takes thirty: all particles share one past, and none of them can
correct the lap. The filter is pulled back to the old landmarks instead, over seconds, with the error between old and
new map spread over both; often it grows first, and the filter's σ does not show it. The batch closes the loop.

Pictures: the map from above with 3σ ellipses, and the error over time with the filter's own 3σ.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.core.filter import Filter
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.mono.config import InverseDepthConfig, MonoConfig
from rbpf.systems.mono.run import run
from rbpf.validation.camera_map import summarise_points
from rbpf.validation.consistency.pose_errors import pose_errors
from rbpf.validation.gtsam.camera import solve_features
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.walked_worlds import CorridorWorld, LoopWorld
from rbpf.validation.sweep.parallel import in_parallel
from rbpf.validation.tables import write_table

SETTINGS = {
    "desk's prior": MonoConfig(
        inverse_depth=InverseDepthConfig(mean_per_m=0.8, std_per_m=0.4, from_scene_depth=False)
    ),
    "room's prior": MonoConfig(
        inverse_depth=InverseDepthConfig(mean_per_m=0.3, std_per_m=0.15, from_scene_depth=False)
    ),
    "default": MonoConfig(),
    "3 linearisations": MonoConfig(proposal=ProposalConfig(iterations=3)),
}
DRAWN = "default"
SECOND = 30  # frames
AWAY, SETTLED = 10 * SECOND, 2 * SECOND  # unseen that long is gone; so long after the closing


class Job(NamedTuple):
    """One recording."""

    world: LoopWorld | CorridorWorld
    seed: int
    particles: int


class Walk(NamedTuple):
    """What is kept of one filter: positions (T, 3), errors and σ (T,) [m], map, ancestors by frame at the closing."""

    path: np.ndarray
    error: np.ndarray
    sigma: np.ndarray
    map: MapEstimate
    ancestors: list[int]


class Recording(NamedTuple):
    """Truth and batch positions (T, 3), frame of the closing or None, and the filters by setting."""

    truth: np.ndarray
    batch: np.ndarray
    closing: int | None
    walks: dict[str, Walk]


def recorded(job: Job) -> Recording:
    """Simulates, solves and filters."""
    log = simulate_features(job.world, Measuring(), MONO, job.seed)
    batch = solve_features(log, marginals=False).world_from_camera
    closing = first_return(log)
    configs = {n: replace(c, particles=job.particles, seed=job.seed) for n, c in SETTINGS.items()}
    walks = {name: walked(log, config, closing) for name, config in configs.items()}
    return Recording(log.truth.world_from_camera[:, 4:], batch[:, 4:], closing, walks)


def first_return(log: FeatureLog) -> int | None:
    """Frame in which a landmark is seen again after a long time."""
    seen: dict[int, int] = {}
    for t, frame in enumerate(log.frames):
        names = frame.landmarks.tolist()
        if any(t - seen.get(name, t) > AWAY for name in names):
            return t
        seen |= dict.fromkeys(names, t)
    return None


def walked(log: FeatureLog, config: MonoConfig, closing: int | None) -> Walk:
    """Filters, and looks at the ancestors at the closing."""
    generations, ancestors = list[int](), list[int]()

    def count(t: int, filter_: Filter, report: object) -> None:
        generations.append(filter_.lineage.generation)
        if t == closing:
            ancestors.extend(filter_.lineage.distinct(generation) for generation in generations)

    done = run(log, config, count)
    errors = pose_errors(done.world_from_camera, done.cov, log.truth.world_from_camera)
    sigma = np.sqrt(np.trace(done.cov[:, 3:, 3:], axis1=1, axis2=2))
    path, summary = done.world_from_camera[:, 4:], summarise_points(done.filter)
    return Walk(path, errors.distances, sigma, summary, ancestors)


def off_by(path: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances (T,) of positions (T, 3)."""
    return np.linalg.norm(path - truth, axis=1)


def draw(name: str, recording: Recording, path: Path) -> None:
    """Map and path from above; error over time."""
    walk = recording.walks[DRAWN]
    long = name == "corridor"
    figure = Figure(figsize=(12.0, 7.5) if long else (13.0, 6.0), layout="constrained")
    above, below = figure.subplots(*((2, 1) if long else (1, 2)))
    circle = 3.0 * np.stack([f(np.linspace(0.0, 2.0 * np.pi, 30)) for f in (np.cos, np.sin)])
    for point, cov in zip(walk.map.mean, walk.map.cov, strict=True):
        edge = point[:2, None] + np.linalg.cholesky(cov[:2, :2]) @ circle
        above.plot(*edge, color="tab:red", lw=0.5)
    above.plot(*walk.map.mean[:, :2].T, ".", color="tab:red", ms=1.5, label="landmarks, 3σ")
    above.plot(*recording.truth[:, :2].T, color="black", lw=2.0, label="truth")
    above.plot(*walk.path[:, :2].T, color="tab:blue", lw=1.2, label="filter")
    above.set(title=f"{name} from above: {len(walk.map.ids)} landmarks", xlabel="x [m]", ylabel="y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize="small", loc="upper right")
    below.plot(walk.error, color="tab:blue", lw=1.0, label="error of the filter")
    below.plot(3.0 * walk.sigma, color="tab:blue", lw=1.0, ls=":", label="the filter's own 3σ")
    below.plot(off_by(recording.batch, recording.truth), color="tab:orange", lw=1.0, label="batch")
    if recording.closing is not None:
        below.axvline(recording.closing, color="black", lw=0.8, ls="--", label="first landmarks back")
    below.set(title="position without alignment", xlabel="frame", ylabel="error [m]", ylim=(0.0, None))
    below.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def row(seed: int, name: str, recording: Recording) -> list[str | int | float]:
    """One line of the table, in centimetres."""
    walk, closing = recording.walks[name], recording.closing
    both = off_by(recording.batch, recording.truth), walk.error
    rms = [100.0 * float(np.sqrt(np.square(error).mean())) for error in both]
    start: list[str | int | float] = [seed, name, *rms, rms[1] / rms[0]]
    if closing is None:
        return [*start, *["-"] * 6]
    windows = slice(closing - SECOND, closing), slice(closing + SETTLED, closing + SETTLED + SECOND)
    found = [100.0 * float(values[w].mean()) for w in windows for values in (walk.error, walk.sigma)]
    shared = (closing - walk.ancestors.count(1) + 1) / SECOND
    return [*start, *found, walk.ancestors[closing - SECOND], shared]


def main(
    seeds: int = 3,
    particles: int = 250,
    workers: int = 2,
    out: Path = Path("demo/mono_loop"),
    quick: bool = False,
) -> dict[str, float]:
    """Walks through both worlds and prints the table.

    Args:
        seeds: number of recordings of each world.
        particles: of each filter.
        workers: processes.
        out: folder for pictures and table.
        quick: one short recording of each world, and few particles.
    """
    worlds = {"loop": LoopWorld(), "corridor": CorridorWorld()}
    if quick:
        seeds, particles, workers = 1, 20, 1
        worlds = {"loop": LoopWorld(frames=45), "corridor": CorridorWorld(frames=45)}
    keys = list(product(worlds, range(seeds)))
    recordings = in_parallel(recorded, [Job(worlds[name], seed, particles) for name, seed in keys], workers)
    header = ["world", "seed", "setting", "batch [cm]", "filter [cm]", "ratio"]
    header += ["before [cm]", "σ", "after [cm]", "σ", "ancestors 1 s ago", "only one [s ago]"]
    rows = [
        [name, *row(seed, setting, recording)]
        for (name, seed), recording in zip(keys, recordings, strict=True)
        for setting in SETTINGS
    ]
    write_table(out / "walks.csv", header, rows)
    for name in worlds:
        draw(name, recordings[keys.index((name, 0))], out / f"mono_{name}.png")
    print(f"pictures and table in {out}")
    means = {key: [r[5] for r in rows if (r[0], r[2]) == key] for key in product(worlds, SETTINGS)}
    return {" / ".join(key): float(np.mean(values)) for key, values in means.items()}


if __name__ == "__main__":
    tyro.cli(main)
