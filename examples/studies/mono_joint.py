"""One camera on the joint map: is its uncertainty true, and what stands in the way?

Features of a hand-held camera over a desk, four known points, as `mono_desk` has them: particles with maps of their own
beside particles with one joint map, whose rays stay at clones of the path and whose depth waits for parallax. NEES per degree
of freedom is 1 for an honest filter. With *true depth* rays begin at the depth that they have, as uncertain as ever: what is
then gone are errors of linearisation about a wrong depth.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.consistency_runs import Mean
from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.core.filter import Filter
from rbpf.core.models import Belief, Observations, Records
from rbpf.core.proposals import EkfProposal
from rbpf.core.resampling import Consolidation
from rbpf.lie import SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.joint_map import JointMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity, PosePrior
from rbpf.runs.recordings import filter_features
from rbpf.sensors.camera.points import CameraModel, CameraRay
from rbpf.sensors.feature_log import FeatureLog
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor, InverseDepthRays, UnknownDepth
from rbpf.systems.mono.known_start import KnownStart
from rbpf.validation.consistency.statistic import whitened_errors
from rbpf.validation.tables import write_table

LEAST_PX = 3.0
"""Parallax of one standard deviation of depth from where on it is measured."""
LINEARISATIONS = 3
"""Of the proposal: moments of the samples hand on what a few weights cannot mend."""
BOUND = 12.5916
"""95 % of χ² with six degrees of freedom."""


class TrueDepth(CameraRay):
    """Begins rays at the inverse depths (by the bytes of what was measured) that they have, as uncertain as they would be."""

    def __init__(self, rho: tuple[float, float], inverse_depth: dict[bytes, float]) -> None:
        super().__init__(MONO, rho)
        self.inverse_depth = inverse_depth

    def initialise(self, state: np.ndarray, z: np.ndarray, cov: np.ndarray) -> Records:
        records = super().initialise(state, z, cov)
        mean = records.mean.copy()
        mean[..., 2] = [self.inverse_depth[each.tobytes()] for each in z]
        return replace(records, mean=mean)


class JointRays(UnknownDepth):
    """Rays as a joint map takes them: as they are, in one group. The rest is as particles with maps of their own have it."""

    def __init__(self, config: MonoConfig) -> None:
        self.true: dict[bytes, float] | None = None
        self.own = InverseDepthRays(MONO, config.inverse_depth)
        self.landmark = InverseDepth(config.inverse_depth.promote_std_ratio, LEAST_PX)
        self.model, self.weight = self.own.model, config.inverse_depth.promote_weight

    def starting(self, depths: np.ndarray) -> CameraModel:
        model = self.own.starting(depths)
        assert isinstance(model, CameraRay)
        return model if self.true is None else TrueDepth(model.rho, self.true)

    def observations(
        self, belief: Belief, z: np.ndarray, cov: np.ndarray, ids: np.ndarray, scaled: bool, held: bool
    ) -> list[Observations]:
        return [Observations(z, cov, self.model, ids=ids)]

    def promotable(self, belief: Belief, observed: object) -> np.ndarray:
        ids = belief.map.ids
        rays = ids[belief.map.are(ids, self.landmark)]
        if not rays.size:
            return rays
        return np.asarray(rays[belief.weights @ self.landmark.ready(belief.read(rays)) >= self.weight])

    def depth_std_ratio(self, records: Records) -> np.ndarray:
        return self.own.depth_std_ratio(records)

    def extent(self, records: Records, sigmas: float, min_weight: float = 0.0) -> np.ndarray:
        return self.own.extent(records, sigmas, min_weight)


def joint_run(log: FeatureLog, config: MonoConfig, window: int, true_depth: bool) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 7) and covariances (T, 6, 6) by a joint map."""
    assert log.known is not None and log.truth is not None
    velocity, known, n = config.velocity, log.known, config.particles
    joint, rays = JointMap(SE3, (np.zeros(6), np.diag(velocity.start_std() ** 2))), JointRays(config)
    filter_ = Filter(
        MarginalVelocity(velocity.walk_std()), FeatureSensor(MONO, rays, config.max_new_per_frame), joint,
        EkfProposal(iterations=LINEARISATIONS), n=n, rng=np.random.default_rng(config.seed), lag=1,
        consolidation=Consolidation(window),
    )  # fmt: skip
    points = np.broadcast_to(known.positions, (n, *known.positions.shape))
    joint.add_records(Records(points, np.broadcast_to(known.cov, (n, *known.cov.shape))), Point(3), ids=known.names)
    start = KnownStart.from_frame(MONO, known, log.frames[0])
    std = np.repeat([config.start_std_rad, config.start_std_m], 3)
    prior: PosePrior | None = PosePrior(start.world_from_camera, np.diag(std**2))
    poses, covs = [], []
    for frame, pose in zip(log.frames, log.truth.world_from_camera, strict=True):
        if true_depth:
            places = np.array([log.truth.landmarks[name] for name in frame.landmarks.tolist()]).reshape(-1, 3)
            depth = SE3.inverse_transform(pose, places)[:, 2]
            rays.true = {z.tobytes(): 1.0 / one for z, one in zip(frame.z, depth.tolist(), strict=True)}
        filter_.step(frame, prior, frame.stamp_ns)
        estimate, prior = joint.estimate(filter_.particles), None
        poses.append(estimate.mean)
        covs.append(estimate.cov)
    return np.array(poses), np.array(covs)


def draw(curves: dict[str, np.ndarray], path: Path) -> None:
    """The median of the recordings' NEES (S, T) over time, and all of them thinly."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for number, (name, nees) in enumerate(curves.items()):
        axes.plot(np.median(nees, axis=0), color=f"C{number}", label=name)
        axes.plot(nees.T, color=f"C{number}", lw=0.4, alpha=0.4)
    axes.axhline(1.0, color="black", lw=0.8)
    axes.set(xlabel="frame", ylabel="NEES / 6", yscale="log", title="pose, median of the recordings and each of them")
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main(
    seeds: int = 10,
    first: int = 0,
    frames: int = 100,
    particles: int = 50,
    own_maps: int = 250,
    windows: tuple[int, ...] = (1, 5),
    out: Path = Path("demo/mono_joint"),
    quick: bool = False,
) -> dict[str, float]:
    """Simulates and filters; prints a line per filter, with its mean NEES as the result.

    Args:
        seeds: number of recordings, with one seed of world and filter each.
        first: the first seed.
        frames: of a recording.
        particles: of the joint map.
        own_maps: particles with maps of their own.
        windows: frames of the joint map's window.
        out: folder for table and picture.
        quick: two short recordings, few particles.
    """
    if quick:
        seeds, frames, own_maps, windows = 2, 30, 30, (1,)
    names = [f"maps of their own, {own_maps}"]
    names += [f"joint map, {particles}, window {w}{end}" for w in windows for end in ("", ", true depth")]
    errors: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    curves: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for seed in range(first, first + seeds):
        log = simulate_features(DeskWorld(frames=frames), Measuring(), MONO, seed)
        assert log.truth is not None
        truth = log.truth.world_from_camera
        own = filter_features(log, MonoConfig(particles=own_maps, seed=seed)).log
        paths = [(own.poses, own.covs)]
        config = MonoConfig(particles=particles, seed=seed)
        paths += [joint_run(log, config, window, true) for window in windows for true in (False, True)]
        for name, (poses, covs) in zip(names, paths, strict=True):
            nees = whitened_errors(SE3, poses, covs, truth).nees
            curves[name].append(nees / 6.0)
            distance = np.linalg.norm(poses[:, 4:] - truth[:, 4:], axis=1)
            inside = 100.0 * float((nees <= BOUND).mean())
            errors[name].append((float(nees.mean()) / 6.0, inside, 1e3 * float(np.sqrt(np.square(distance).mean()))))
            print(seed, name, *(f"{value:.2f}" for value in errors[name][-1]), flush=True)
    rows = list[list[str | int | float]]()
    for name, of_runs in errors.items():
        nees, inside, mm = np.array(of_runs).T
        mean, held = Mean.of(nees), Mean.of(inside)
        rows.append(
            [
                name, seeds, mean.value, mean.error, float(np.median(nees)), nees.max(), held.value, held.error,
                mm.mean(), float(np.median(mm)), mm.max(),
            ]
        )  # fmt: skip
    header = [
        "filter", "runs", "NEES / 6", "± s.e.", "median", "worst", "in 95 % [%]", "± s.e.", "error [mm]", "median", "worst",
    ]  # fmt: skip
    write_table(out / "mono_joint.csv", header, rows)
    draw({name: np.array(of_runs) for name, of_runs in curves.items()}, out / "mono_joint.png")
    return {name: float(np.median(np.array(of_runs)[:, 0])) for name, of_runs in errors.items()}


if __name__ == "__main__":
    tyro.cli(main)
