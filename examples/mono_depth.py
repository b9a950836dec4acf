"""Why inverse depth? (E06, figure 2)

A camera moves sideways, a little forward, and sees one point again and again with 1 px noise. The first sighting gives
a ray; how likely each depth on it is after 1 … 10 more sightings is computed on a fine grid, without any linearisation.
The left picture has it over depth: at first with a heavy tail towards infinity, later a bell. The right picture has the
same data over inverse depth: a bell from the start. Dotted is the Gaussian with the same mean and variance, which is
what a Kalman filter works with. The table says how far the curve is from that Gaussian, the mean of many repetitions:
Kullback-Leibler divergence (0 is a Gaussian) and skewness (0 is symmetric), and how well depth is known by then: a ray
becomes a point when σ/ρ is below 0.1.

Each curve is the likelihood, normalised over depths of 0.2 … 20 m, each in its own variable as the paper draws it.
"""

from pathlib import Path

import numpy as np
import tyro

from rbpf.lie import SE3
from rbpf.runs.plots import save_figures
from rbpf.validation.e06.depth_curves import Passing, draw_curves, shape_of
from rbpf.validation.simulation.features import MONO
from rbpf.validation.tables import write_table

STD_PX = 1.0
DEPTH_M, FIRST_PX = 2.0, np.array([360.0, 220.0])
STEP_M = np.array([0.02, 0.0, 0.004])  # per sighting: to the right, and forward
NEAREST_M, FARTHEST_M = 0.2, 20.0
SIGHTINGS = 10


def passing() -> Passing:
    """The camera."""
    poses = np.tile(SE3.identity(), (SIGHTINGS, 1))
    poses[:, 4:] = np.arange(1, SIGHTINGS + 1)[:, None] * STEP_M
    return Passing(MONO, poses, STD_PX)


def measure(repetitions: int, rng: np.random.Generator) -> np.ndarray:
    """(R, 2K) pixels; the first sighting's noise is in all of them, because the ray is drawn through it."""
    true = passing().predict(FIRST_PX, np.array([1.0 / DEPTH_M]))
    return true.px + rng.normal(size=(repetitions, 2 * SIGHTINGS)) @ true.chol[0].T


def main(
    repetitions: int = 100, out: Path = Path("demo/mono_depth"), quick: bool = False
) -> dict[str, float]:
    """Computes the likelihoods and prints how far from a Gaussian they are.

    Args:
        repetitions: of the noise.
        out: folder for picture and table.
        quick: few repetitions on a coarse grid.
    """
    repetitions, cells = (10, 1000) if quick else (repetitions, 4000)
    z = measure(repetitions, np.random.default_rng(0))
    depth = np.linspace(NEAREST_M, FARTHEST_M, cells)
    rho = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, cells)
    camera = passing()
    of_depth = [shape_of(depth, curves) for curves in camera.log_likelihoods(FIRST_PX, 1.0 / depth, z)]
    of_rho = [shape_of(rho, curves) for curves in camera.log_likelihoods(FIRST_PX, rho, z)]

    header = [
        "sightings",
        "baseline [m]",
        "σ/ρ",
        "KL depth",
        "KL inverse",
        "skewness depth",
        "skewness inverse",
    ]
    rows = []
    for k, (far, inverse) in enumerate(zip(of_depth, of_rho, strict=True), start=1):
        numbers = [far.divergence, inverse.divergence, far.skewness, inverse.skewness]
        ratio = float(np.median(inverse.std / inverse.mean))
        rows.append([k, float(k * STEP_M[0]), ratio, *(float(n.mean()) for n in numbers)])
    write_table(out / "gaussianity.csv", header, rows)
    curves = {"depth [m]": (depth, of_depth), "inverse depth [1/m]": (rho, of_rho)}
    save_figures({"mono_depth.png": draw_curves(curves, DEPTH_M)}, out)
    print(f"picture and table in {out}")
    return {"kl_depth": rows[1][3], "kl_inverse": rows[1][4], "kl_depth_end": rows[-1][3]}


if __name__ == "__main__":
    tyro.cli(main)
