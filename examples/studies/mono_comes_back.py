"""Loop closure by place recognition: a camera returns after a lap of a room, with an uncertain pose.

Few features are measured, so that it returns with an error of some decimetres, more than active search can bridge. The
pictures on the walls differ in one world; another room is symmetric under rotation by half a turn; in a third every picture
hangs twice, side by side. Each is filtered with and without place recognition. A loop closure is wrong if the position error
afterwards exceeds three standard deviations, and the error before.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.parallel import in_parallel
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers import ImageFrame, ImageSequence, KnownPixels
from rbpf.sensors.readers.images.sequence import Source
from rbpf.systems.mono.config import MonoConfig, RelocalisationConfig, SearchConfig
from rbpf.systems.mono.slam import COME_BACK
from rbpf.validation.simulation import textures
from rbpf.validation.simulation.images import known_corners
from rbpf.validation.simulation.paths import Wave, looking
from rbpf.validation.simulation.render import Renderer
from rbpf.validation.simulation.textured_scene import Furniture, Rectangle, TexturedScene, stamps_ns

Twins = Literal["none", "across", "beside"]
CAMERA = Pinhole(320, 240, 220.0, 220.0, 159.5, 119.5)
HALF_M, HIGH_M, RADIUS_M, EYE_M = np.array([5.0, 4.0]), 2.6, 2.5, 1.4
FRAMES, RATE_HZ, LAPS, GREY_LEVELS, KNOWN = 560, 30.0, 1.2, 3.0, 8
CONFIG = MonoConfig(submap=60, search=SearchConfig(measurements=12, min_in_view=18))
NEVER = replace(CONFIG, relocalisation=RelocalisationConfig(ask_every=10**6))


def room(twins: Twins, rng: np.random.Generator) -> TexturedScene:
    """A room with a path in a circle, facing outwards."""
    turn = 2.0 * np.pi * LAPS * np.arange(FRAMES) / FRAMES
    heading = turn + np.deg2rad(30.0)
    eye = np.stack([RADIUS_M * np.cos(turn), RADIUS_M * np.sin(turn), np.full_like(turn, EYE_M)], axis=-1)
    ahead = np.stack([np.cos(heading), np.sin(heading), np.full_like(turn, -0.1)], axis=-1)
    shake = Wave.random(np.repeat([np.deg2rad(2.0), 0.03], 3), (0.3, 1.5), rng)(np.arange(FRAMES) / RATE_HZ)
    box = np.array([[*-HALF_M, 0.0], [*HALF_M, HIGH_M]])
    walls, shell = Furniture(rng, 0.005, 1.0), Furniture(rng, 0.005, 1.0)
    shell.shell(box, textures.plaster, textures.carpet, textures.plaster)
    for wall, k in product(range(2 if twins == "across" else 4), range(3 if twins == "beside" else 7)):
        size, up, along = rng.uniform(0.4, 0.9, 2).tolist(), rng.uniform(0.3, 0.6), rng.uniform(0.35, 0.65)
        for place in [(2 * k + along) / 6, (2 * k + 1 + along) / 6] if twins == "beside" else [(k + along) / 7]:
            walls.hang(box, wall, (place, up), size, textures.picture)
        if twins == "beside":
            walls.rectangles[-1] = replace(walls.rectangles[-1], texture=walls.rectangles[-2].texture)
    if twins == "across":
        walls.rectangles += shell.rectangles[:2]
        half_turn = np.array([-1.0, -1.0, 1.0])
        for each in list(walls.rectangles):
            corner, across, down = (half_turn * side for side in (each.corner, each.across, each.down))
            walls.rectangles.append(Rectangle(corner, across, down, each.texture, each.gain))
        shell.rectangles[:4] = []
    path = SE3.retract(looking(eye, ahead), shake)
    return TexturedScene("room", stamps_ns(FRAMES, RATE_HZ), path, [*shell.rectangles, *walls.rectangles])


@dataclass(frozen=True)
class Rendered(Source):
    """Images of a scene, rendered when needed; a frame's noise depends only on its number."""

    scene: TexturedScene

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.scene.rectangles, CAMERA, 1)

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        for t in range(start, len(self.scene.stamps_ns)):
            light = self.renderer.image(self.scene.world_from_camera[t])
            noise = GREY_LEVELS * np.random.default_rng(t).standard_normal(light.shape)
            yield ImageFrame(int(self.scene.stamps_ns[t]), np.clip(light + noise, 0, 255).astype(np.uint8))


def sequence(twins: Twins, seed: int) -> tuple[ImageSequence, KnownPixels]:
    """Images and known points in the frame of the first camera."""
    scene = room(twins, np.random.default_rng(seed))
    source, first = Rendered(scene), SE3.inverse(scene.world_from_camera[0])
    px, places = known_corners(scene, source.renderer, CAMERA, KNOWN)
    known = KnownPixels(np.arange(KNOWN), px, SE3.transform(first, places), np.full(KNOWN, 0.003))
    truth = Truth(scene.stamps_ns, SE3.compose(first, scene.world_from_camera), {})
    return ImageSequence("room", CAMERA, scene.stamps_ns, truth, None, source), known


@dataclass(frozen=True)
class Job:
    """A world, and whether place recognition is used."""

    twins: Twins
    seed: int
    asks: bool


@dataclass(frozen=True)
class Outcome:
    """Outcome of a run over T frames."""

    off: np.ndarray  #: (T,) error of the position, metres.
    std: np.ndarray  #: (T,) the run's standard deviation of it, metres.
    nees: np.ndarray  #: (T,) of the pose, per degree of freedom.
    closed: list[int]  #: frames of loop closures.
    milliseconds: float  #: mean time per frame, with rendering.

    @property
    def before(self) -> float:
        """Error after seven eighths of the first lap."""
        return float(self.off[int(0.875 * len(self.off) / LAPS)])

    @property
    def late(self) -> slice:
        """The last twentieth."""
        return slice(-(len(self.off) // 20), None)

    @property
    def wrong(self) -> int:
        """Number of wrong loop closures."""
        return sum(self.off[t] > max(self.off[t - 1], 3.0 * self.std[t]) for t in self.closed)


def walk(job: Job) -> Outcome:
    """A whole run."""
    images, known = sequence(job.twins, job.seed)
    run = filter_opened(open_mono(images, CONFIG if job.asks else NEVER, known))
    assert images.truth is not None
    error, covs = SE3.local(run.log.poses, images.truth.poses), run.log.covs
    nees = np.array([e @ np.linalg.solve(cov, e) / 6.0 for e, cov in zip(error, covs, strict=True)])
    closed = [int(words.split(":")[0].removeprefix("frame ")) for words in run.messages if COME_BACK in words]
    std = np.sqrt(np.trace(covs[:, 3:, 3:], axis1=1, axis2=2))
    spent = 1e3 * float(np.mean(run.log["seconds"]))
    return Outcome(np.linalg.norm(error[:, 3:], axis=1), std, nees, closed, spent)


def main(
    seeds: int = 4, workers: int = 2, out: Path = Path("demo/mono_comes_back"), quick: bool = False
) -> dict[str, float]:
    """Renders, filters, and prints the table.

    Args:
        seeds: number of rooms of each kind.
        workers: processes.
        out: folder for the table and the plot.
        quick: one room, and no run without place recognition.
    """
    worlds: list[Twins] = ["none"] if quick else ["none", "across", "beside"]
    asked, seeds = ([True], 1) if quick else ([True, False], seeds)
    jobs = [Job(twins, seed, asks) for twins in worlds for asks in asked for seed in range(seeds)]
    found = list(zip(jobs, in_parallel(walk, jobs, 1 if quick else workers), strict=True))
    header = ["twins", "seed", "asks", "before [m]", "after [m]", "NEES / 6", "closed", "wrongly", "ms per frame"]
    rows, figure = [], Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for job, one in found:
        after, nees = float(one.off[one.late].mean()), float(one.nees[one.late].mean())
        about = [job.twins, job.seed, int(job.asks)]
        rows.append([*about, one.before, after, nees, len(one.closed), one.wrong, one.milliseconds])
        axes.plot(one.off, lw=0.9, label=f"{job.twins}, {job.seed}" if job.asks else None, ls="-" if job.asks else ":")
    axes.set(xlabel="frame", ylabel="error [m]", title="The position; dotted: not asked where it has been")
    axes.legend(fontsize="small")
    write_table(out / "loops.csv", header, rows)
    figure.savefig(out / "mono_comes_back.png", dpi=110)
    asking = [one for job, one in found if job.asks]
    distinct = [one for job, one in found if job.asks and job.twins == "none"]
    before = float(np.mean([one.before for one in distinct]))
    after = float(np.mean([one.off[one.late] for one in distinct]))
    print(f"rooms without twins: {before:.2f} m off before the camera comes back, {after:.3f} m at the end")
    return {"before": before, "after": after, "wrong": float(sum(one.wrong for one in asking))}


if __name__ == "__main__":
    tyro.cli(main)
