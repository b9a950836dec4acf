"""Are the rendered worlds easier than life? What active search finds in them, beside real recordings.

The same system with the same settings filters every sequence. The first table has the fraction of the searches that ended
with a match, and of those that did not why: nothing in the ellipse was alike enough, or what was alike was astray: it
did not agree with where the camera went. Then the correlation of what was found: the median, and the tenth that was
least alike. Survival is the fraction of features that are not dropped within so many frames of being looked for (Kaplan
and Meier's estimate). Noise and contrast are those of the images themselves, grey levels: the noise is read off the
smoothest blocks, which in compressed video have lost it.

    python examples/mono_realism.py --recordings DATA/mono_redkitchen_a DATA/stereo_zed_room1 DATA/mono_robot_lateral

The rendered desk and room are made twice: as the defaults of the simulator are, and with perfect pictures. The length
counts: in its first seconds a camera sees everything from nearly where it saw it first, and finds it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.runs.plots import save_figures
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.search_statistics import SearchStatistics, measure_search
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.simulation.textured_room import TexturedRoom
from rbpf.validation.simulation.textured_scene import ImageWorld
from rbpf.validation.tables import write_table

PERFECT = {"noise_std": 1.0, "exposure_drift": 0.0, "blur_s": 0.0, "vignetting": 0.0}
WATCHED = 300
TOLD = 30, 100, 300


def rendered(out: Path, frames: int, quick: bool) -> dict[str, Path]:
    """Folders of the rendered sequences by name; rendered unless they have been before."""
    size = (320, 240) if quick else (640, 480)
    camera = Pinhole(*size, 0.82 * size[0], 0.82 * size[0], 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5)
    texel_m = 0.002 if quick else 0.001
    worlds: dict[str, ImageWorld] = {"desk": TexturedDesk(frames=frames, texel_m=texel_m)}
    if not quick:
        worlds["room"] = TexturedRoom(frames=frames)
    imaging = Imaging(grid=1 if quick else 2)
    looks = {"": imaging, ", perfect pictures": replace(imaging, **PERFECT)}
    folders = {}
    for name, world in worlds.items():
        for suffix, look in looks.items():
            folder = out / f"{name}{'_perfect' if suffix else ''}"
            if not folder.exists():
                simulate_images(world, look, camera, folder, seed=0)
            folders[f"rendered {name}{suffix}"] = folder
    return folders


def draw(found: list[SearchStatistics]) -> Figure:
    """Histograms of the correlation of what was taken and what was not; survival."""
    figure = Figure(figsize=(12.0, 4.2 + 1.7 * ((len(found) + 2) // 3)), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.7 * ((len(found) + 2) // 3), 4.2))
    panels = upper.subplots((len(found) + 2) // 3, 3, sharex=True, squeeze=False)
    bins = np.linspace(0.4, 1.0, 61)
    for axes, one in zip(panels.flat, found, strict=False):
        fractions = [np.full(part.sum(), 1.0 / one.score.size) for part in (one.found, ~one.found)]
        score = np.maximum(one.score, bins[0])
        axes.hist(
            [score[one.found], score[~one.found]], bins, weights=fractions, stacked=True,
            color=["tab:green", "tab:red"], label=["taken", "not taken"],
        )  # fmt: skip
        axes.axvline(one.accept, color="black", lw=0.8, ls="--")
        axes.set_title(f"{one.name}: {one.share_found:.0%} found", fontsize="small")
        axes.set_yscale("log")
    for axes in panels.flat[len(found) :]:
        axes.set_axis_off()
    panels[0, 0].legend(fontsize="small")
    for axes in panels[-1]:
        axes.set_xlabel("normalised cross-correlation")
    curve = lower.subplots()
    for one in found:
        style = "-" if "rendered" not in one.name else "--" if "perfect" not in one.name else ":"
        curve.plot(one.survival(WATCHED), style, label=one.name)
    curve.set(
        xlabel="frames in which it was looked for",
        ylabel="fraction of features not dropped",
        ylim=(0.0, 1.02),
    )
    curve.grid(alpha=0.3)
    curve.legend(fontsize="small")
    return figure


def main(
    recordings: tuple[Path, ...] = (),
    frames: int = 600,
    particles: int = 50,
    seed: int = 0,
    out: Path = Path("demo/mono_realism"),
    quick: bool = False,
) -> dict[str, float]:
    """Filters recordings and rendered worlds; prints how active search fares.

    Args:
        recordings: folders of real sequences, with known_points.csv where they have any.
        frames: of the rendered sequences.
        particles: of the filter.
        seed: of the filter.
        out: folder for picture, table and rendered sequences.
        quick: a short desk, seen coarsely by few particles.
    """
    frames, particles = (60, 10) if quick else (frames, particles)
    config = MonoConfig(particles=particles, seed=seed)
    folders = {folder.name: folder for folder in recordings} | rendered(out, frames, quick)
    found = [measure_search(folder, config, name) for name, folder in folders.items()]
    header = [
        "sequence", "frames", "lost", "found", "unlike", "astray", "median", "least tenth",
        *(f"survive {n}" for n in TOLD), "noise", "contrast",
    ]  # fmt: skip
    rows = []
    for one in found:
        alike = one.score[one.found]
        survival = one.survival(max(TOLD))[list(TOLD)].tolist()
        fractions = one.share_found, one.share_unlike, one.share_astray
        quantiles = [float(np.quantile(alike, q)) for q in (0.5, 0.1)]
        rows.append(
            [one.name, one.frames, one.lost, *fractions, *quantiles, *survival, one.noise, one.contrast]
        )
    write_table(out / "realism.csv", header, rows)
    save_figures({"mono_realism.png": draw(found)}, out)
    print(f"picture and table in {out}")
    return {one.name: one.share_found for one in found}


if __name__ == "__main__":
    tyro.cli(main)
