"""How many dimensions of uncertainty do the particles carry? (E06, section 6)

Each particle keeps the covariance of each landmark; that two landmarks err together, only the particles can say. The
covariance of all landmarks between the particles, with its 3×3 blocks on the diagonal set to zero, is therefore what
must not be lost, and its eigenvalues say in how many dimensions it lives. The paper finds that they drop to tiny
values after the 30th with 50, 250 and 1,000 particles alike, and concludes that 50 were enough.

The table has, by number of particles: the largest magnitude; the 30th and the N-th relative to it; how many are above a
hundredth and above a thousandth of it; and how many particles of the first frame still have descendants. N particles
give a covariance of rank N − 1 at most, whatever the world is, and resampling lowers it further. A drop before N − 1 is
therefore necessary for having enough of them, not sufficient: compare the curves with each other.
"""

from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.maps.point import Point
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import landmark_cloud, run
from rbpf.validation.consistency.pose_errors import offdiagonal_eigenvalues
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld
from rbpf.validation.sweep.parallel import in_parallel
from rbpf.validation.tables import write_csv, write_table

RANK = 30  # the paper's


class Job(NamedTuple):
    """One run."""

    particles: int
    frames: int
    seed: int


class Spectrum(NamedTuple):
    """Eigenvalues (3K,) [m²], the landmarks' own mean variance within the particles [m²], and distinct ancestors."""

    eigenvalues: np.ndarray
    own: float
    ancestors: int


def spectrum(job: Job) -> Spectrum:
    """Simulates, filters and decomposes the covariance after the last frame."""
    log = simulate_features(DeskWorld(frames=job.frames), Measuring(), MONO, job.seed)
    filter_ = run(log, MonoConfig(particles=job.particles, seed=job.seed)).filter
    belief = filter_.belief()
    ids = belief.map.ids
    points = ids[belief.map.are(ids, Point(3))]
    values = offdiagonal_eigenvalues(landmark_cloud(filter_, points), filter_.particles.log_weights)
    variance = np.trace(belief.read(points).cov, axis1=2, axis2=3) / 3.0
    return Spectrum(values, float(belief.weights @ variance.mean(axis=1)), filter_.history.distinct_first())


def draw(spectra: dict[int, Spectrum], path: Path) -> None:
    """Eigenvalues in descending order."""
    figure = Figure(figsize=(9.0, 5.5), layout="constrained")
    axes = figure.subplots()
    colours = ["tab:red", "tab:orange", "tab:blue"]
    for colour, (particles, found) in zip(colours, spectra.items(), strict=True):
        order = np.arange(1, found.eigenvalues.size + 1)
        axes.plot(order, found.eigenvalues, color=colour, label=f"{particles:,} particles")
        axes.axvline(particles - 1, color=colour, lw=0.8, ls="--")
    axes.axvline(RANK, color="black", lw=0.8, ls=":", label=f"{RANK}th, E06")
    axes.axhline(found.own, color="0.5", lw=0.8, label="a landmark's own variance in each particle")
    largest = max(found.eigenvalues[0] for found in spectra.values())
    axes.set(
        title="off-diagonal covariance of the landmarks; dashed: rank bound N − 1",
        xlabel="eigenvalue, in descending order of magnitude",
        ylabel="magnitude [m²]",
        xscale="log",
        yscale="log",
        ylim=(1e-8 * largest, 3.0 * largest),
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main(
    frames: int = 1000,
    seed: int = 0,
    workers: int = 2,
    out: Path = Path("demo/mono_eigenvalues"),
    quick: bool = False,
) -> dict[str, float]:
    """Filters one recording with each number of particles; prints the table.

    Args:
        frames: of the recording.
        seed: of the recording and the filters.
        workers: processes.
        out: folder for picture and tables.
        quick: a short recording and few particles.
    """
    counts, frames, workers = ((10, 20, 40), 80, 1) if quick else ((50, 250, 1000), frames, workers)
    spectra = dict(
        zip(
            counts,
            in_parallel(spectrum, map(Job, counts, repeat(frames), repeat(seed)), workers),
            strict=True,
        )
    )

    header = [
        "particles",
        "rank bound",
        "landmarks",
        "largest [m²]",
        f"{RANK}th",
        "N-th",
        "> 1/100",
        "> 1/1000",
        "ancestors",
    ]
    rows = []
    for n, (values, _, ancestors) in spectra.items():
        fraction = values / values[0]
        nth = float(fraction[n - 1]) if n <= fraction.size else 0.0
        above = [int((fraction > limit).sum()) for limit in (1e-2, 1e-3)]
        rows.append(
            [n, n - 1, values.size // 3, float(values[0]), float(fraction[RANK - 1]), nth, *above, ancestors]
        )
    write_table(out / "summary.csv", header, rows)
    print(
        f"{RANK}th and N-th relative to the largest; ancestors: particles of the first frame with descendants"
    )
    shortest = min(found.eigenvalues.size for found in spectra.values())
    columns = [[float(found.eigenvalues[k]) for found in spectra.values()] for k in range(shortest)]
    write_csv(
        out / "eigenvalues.csv",
        ["order", *map(str, counts)],
        [[k + 1, *row] for k, row in enumerate(columns)],
    )
    draw(spectra, out / "mono_eigenvalues.png")
    print(f"picture and tables in {out}")
    return {"dominant": float(rows[1][6]), "thirtieth": float(rows[1][4]), "largest": float(rows[1][3])}


if __name__ == "__main__":
    tyro.cli(main)
