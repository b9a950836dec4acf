"""Realism of the rendered worlds: success of active search, compared with real recordings.

The same system with the same settings filters every sequence. The first table has the fraction of searches with a match,
and of failures by cause: no sufficient correlation in the ellipse, or an outlier (astray), which disagrees with the
consensus motion. Then the correlation of matches: median and first decile. Survival is the fraction of features that are
not dropped within a number of searches (Kaplan-Meier estimate). Noise and contrast are of the images themselves, in grey
levels: noise is estimated from the smoothest blocks, which in compressed video have lost it.

    python -m examples.studies.mono_realism --recordings DATA/mono_redkitchen_a DATA/stereo_zed_room1 DATA/mono_robot_lateral

The rendered desk and room are rendered twice: with the simulator's defaults, and with ideal imaging. The length matters:
in the first seconds a camera observes everything from near its first viewpoint, where search is easy.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.runs.files import write_table
from rbpf.runs.plots import save_figures
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.system import Tracked
from rbpf.validation.simulation.desk_and_room import TexturedDesk, TexturedRoom
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.textured_scene import ImageWorld

SMOOTH_FRACTION = 0.05
"""Fraction of an image's blocks, the smoothest, for estimating noise."""
BLOCK_PX = 16
DARKEST, BRIGHTEST = 20.0, 235.0
"""Range of grey levels; blocks outside are clipped and show no noise."""
MOST_IMAGES = 25
"""Blocks for an image's noise and contrast."""


@dataclass(frozen=True)
class SearchStatistics:
    """Statistics of one run; S searches of single features in single frames, F features.

    Attributes:
        name: of the sequence.
        frames: number of filtered frames.
        lost: frames in which the camera was lost.
        score: (S,) best normalised cross-correlation in the ellipse; −1 without a comparison.
        found: (S,) whether it was accepted: correlated enough, and an inlier.
        accept: least score of a match.
        attempts: (F,) frames in which each feature was searched.
        dropped: (F,) whether it was finally dropped because of failures.
        noise: grey levels, standard deviation in the smoothest parts of the images.
        contrast: grey levels, median standard deviation of blocks of `BLOCK_PX`.
    """

    name: str
    frames: int
    lost: int
    score: np.ndarray
    found: np.ndarray
    accept: float
    attempts: np.ndarray
    dropped: np.ndarray
    noise: float
    contrast: float

    @property
    def share_found(self) -> float:
        """Fraction of searches with a match."""
        return float(self.found.mean())

    @property
    def share_unlike(self) -> float:
        """Fraction without sufficient correlation."""
        return float((self.score < self.accept).mean())

    @property
    def share_astray(self) -> float:
        """Fraction of outliers: sufficient correlation, but in disagreement with the other matches."""
        return float(((self.score >= self.accept) & ~self.found).mean())

    def survival(self, most: int) -> np.ndarray:
        """(most + 1,) fraction of features that are not dropped within 0, 1, … searches.

        E. Kaplan and P. Meier's estimate (1958): a feature that left the view, or survived the run, is censored at its
        number of searches.
        """
        return survival(self.attempts, self.dropped, most)


def survival(lengths: np.ndarray, ended: np.ndarray, most: int) -> np.ndarray:
    """Kaplan–Meier estimate (most + 1,) of the fraction that survives beyond 0, 1, … `most`.

    Args:
        lengths: (F,) integer durations of observation.
        ended: (F,) whether it ended then; else it is censored.
        most: last length of the estimate.
    """
    times = np.arange(most + 1)
    at_risk = (lengths[:, None] >= times).sum(axis=0)
    ends = ((lengths[:, None] == times) & ended[:, None]).sum(axis=0)
    return np.asarray(np.cumprod(1.0 - ends / np.maximum(at_risk, 1)))


def measure_search(folder: Path, config: MonoConfig, name: str | None = None) -> SearchStatistics:
    """Filters a sequence, from its known points if it has any, and collects statistics.

    Args:
        folder: of the sequence.
        config: of the run.
        name: of the sequence, by default its folder's.

    Raises:
        InputError: the sequence cannot be filtered.
    """
    points = folder / "known_points.csv"
    known = read_known_points(points) if points.exists() else None
    sequence = open_images(folder)
    every = max(1, len(sequence) // MOST_IMAGES)
    score, found, looks = [], [], []

    def note(run: Run, _: Tracked) -> None:
        measurement = run.system.measurement
        assert measurement is not None
        searched = measurement.search
        score.append(searched.score)
        found.append(searched.found.copy())
        if (len(run.log) - 1) % every == 0 and run.frame.image is not None:
            looks.append(_look(run.frame.image))

    run = filter_opened(open_mono(sequence, config, known), [note])
    table = run.system.sensor.table
    searched_for = np.flatnonzero(table.attempts)
    # Dropped for failing; those that left the view or the present sub-map are censored.
    dropped = np.zeros(len(table), dtype=bool)
    dropped[searched_for] = table.failing(searched_for, config.search)
    noise, contrast = np.median(looks, axis=0).tolist()
    return SearchStatistics(
        name or folder.name,
        run.log.stamps_ns.size,
        int(run.log.lost().sum()),
        np.concatenate(score),
        np.concatenate(found),
        config.search.min_correlation,
        table.attempts.copy(),
        dropped,
        noise,
        contrast,
    )


def _look(image: np.ndarray) -> tuple[float, float]:
    """Noise, and contrast of blocks, in grey levels.

    The noise is the least residual of a kernel that cancels planes (J. Immerkær 1996).
    """
    grey = image.astype(float)
    inner = grey[:-2] - 2.0 * grey[1:-1] + grey[2:]
    rough = _blocks((inner[:, :-2] - 2.0 * inner[:, 1:-1] + inner[:, 2:]) / 6.0).std(axis=1)
    blocks = _blocks(grey[1:-1, 1:-1])
    level = blocks.mean(axis=1)
    light = (level > DARKEST) & (level < BRIGHTEST)
    smooth = rough[light] if light.any() else rough
    return float(np.quantile(smooth, SMOOTH_FRACTION)), float(np.median(blocks.std(axis=1)))


def _blocks(grey: np.ndarray) -> np.ndarray:
    """(B, BLOCK_PX²) values."""
    rows, columns = (size // BLOCK_PX for size in grey.shape)
    cut = grey[: rows * BLOCK_PX, : columns * BLOCK_PX]
    parts = cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).swapaxes(1, 2)
    return np.asarray(parts.reshape(rows * columns, -1))


PERFECT = {"noise_std": 1.0, "exposure_drift": 0.0, "blur_s": 0.0, "vignetting": 0.0}
WATCHED = 300
TOLD = 30, 100, 300


def rendered(out: Path, frames: int, quick: bool) -> dict[str, Path]:
    """Folders of the rendered sequences by name; rendered unless they exist."""
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
    """Plots histograms of the correlation of accepted and rejected matches, and survival."""
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
    curve.set(xlabel="frames in which it was looked for", ylabel="fraction of features not dropped", ylim=(0.0, 1.02))
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
    """Filters recordings and rendered worlds; prints statistics of active search.

    Args:
        recordings: folders of real sequences, with known_points.csv if any.
        frames: of the rendered sequences.
        particles: of the filter.
        seed: of the filter.
        out: folder for picture, table and rendered sequences.
        quick: a short desk with small images and few particles.
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
        rows.append([one.name, one.frames, one.lost, *fractions, *quantiles, *survival, one.noise, one.contrast])
    write_table(out / "realism.csv", header, rows)
    save_figures({"mono_realism.png": draw(found)}, out)
    print(f"picture and table in {out}")
    return {one.name: one.share_found for one in found}


if __name__ == "__main__":
    tyro.cli(main)
