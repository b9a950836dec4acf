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
from typing import NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.lie import SE3
from rbpf.sensors.camera_points import CameraRay
from rbpf.validation.simulation.features import MONO
from rbpf.validation.tables import write_table

STD_PX = 1.0
DEPTH_M, FIRST_PX = 2.0, np.array([360.0, 220.0])
STEP_M = np.array([0.02, 0.0, 0.004])  # per sighting: to the right, and forward
NEAREST_M, FARTHEST_M = 0.2, 20.0
SIGHTINGS = 10
SHOWN = (1, 2, 3, 5, 10)


class Sightings(NamedTuple):
    """What each depth of a grid predicts for K later sightings.

    Attributes:
        px: (G, 2K), of the ray through the first pixel.
        chol: (G, 2K, 2K) of the covariance, with the first sighting's own noise.
    """

    px: np.ndarray
    chol: np.ndarray


def predict(rho: np.ndarray) -> Sightings:
    """Sightings of points at inverse depths (G,) on the ray through the first pixel."""
    ray = CameraRay(MONO)
    poses = np.tile(SE3.identity(), (SIGHTINGS, 1))
    poses[:, 4:] = np.arange(1, SIGHTINGS + 1)[:, None] * STEP_M
    uv = np.broadcast_to(MONO.unproject(FIRST_PX[None]), (len(rho), 2))
    landmark = np.concatenate([uv, rho[:, None]], axis=1)[:, None]
    px = ray.predict(poses, landmark, SE3.identity())
    slope = ray.jacobians(poses, landmark, SE3.identity()).landmark[..., :2].reshape(len(rho), -1, 2)
    moved = slope @ (STD_PX * MONO.unproject_slope(FIRST_PX[None])[0])
    cov = moved @ np.swapaxes(moved, 1, 2) + STD_PX**2 * np.eye(2 * SIGHTINGS)
    return Sightings(px.reshape(len(rho), -1), np.linalg.cholesky(cov))


def measure(repetitions: int, rng: np.random.Generator) -> np.ndarray:
    """(R, 2K) pixels; the first sighting's noise is in all of them, because the ray is drawn through it."""
    true = predict(np.array([1.0 / DEPTH_M]))
    return true.px + rng.normal(size=(repetitions, 2 * SIGHTINGS)) @ true.chol[0].T


def log_likelihoods(rho: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of inverse depths (G,) after each of the K sightings, (K, R, G), for pixels (R, 2K).

    The first rows of a Cholesky factor are the factor of the first rows: one solution serves any number of sightings.
    """
    expected = predict(rho)
    white = np.linalg.solve(expected.chol, np.moveaxis(z[:, None] - expected.px, 0, -1))
    scale = np.log(np.diagonal(expected.chol, axis1=1, axis2=2))[..., None]
    return np.moveaxis(-np.cumsum(0.5 * white**2 + scale, axis=1)[:, 1::2], 0, -1)


class Shape(NamedTuple):
    """Curves (R, G) over a grid, and what tells them from a Gaussian (R,)."""

    density: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    divergence: np.ndarray
    skewness: np.ndarray


def shape_of(grid: np.ndarray, log_density: np.ndarray) -> Shape:
    """Normalises; moments; Kullback-Leibler divergence from the Gaussian with the same mean and variance, in nats."""
    cell = np.gradient(grid)
    density = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    density /= (density @ cell)[:, None]
    mean = density @ (grid * cell)
    offset = grid - mean[:, None]
    std = np.sqrt((density * offset**2) @ cell)
    gaussian = -0.5 * (offset / std[:, None]) ** 2 - np.log(np.sqrt(2.0 * np.pi) * std)[:, None]
    log_ratio = np.log(np.maximum(density, np.finfo(float).tiny)) - gaussian
    return Shape(density, mean, std, (density * log_ratio) @ cell, (density * offset**3) @ cell / std**3)


def draw(curves: dict[str, tuple[np.ndarray, list[Shape]]], path: Path) -> None:
    """The first repetition's curves, over depth and over inverse depth."""
    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    limits = {"depth [m]": (0.0, 8.0), "inverse depth [1/m]": (0.0, 1.3)}
    colours = ["tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple"]
    for axes, (name, (grid, shapes)) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        for colour, sightings in zip(colours, SHOWN, strict=True):
            shape = shapes[sightings - 1]
            label = f"{sightings} sighting{'s' * (sightings > 1)}"
            axes.plot(grid, shape.density[0] / shape.density[0].max(), color=colour, label=label)
            deviation = (grid - shape.mean[0]) / shape.std[0]
            height = 1.0 / (np.sqrt(2.0 * np.pi) * shape.std[0] * shape.density[0].max())
            axes.plot(grid, height * np.exp(-0.5 * deviation**2), ":", color=colour, lw=1.2)
        true = DEPTH_M if name.startswith("depth") else 1.0 / DEPTH_M
        axes.axvline(true, color="black", lw=0.8, ls="--", label="truth")
        axes.set(
            title=f"likelihood of {name.split(' [')[0]}",
            xlabel=name,
            ylabel="relative to its peak",
            xlim=limits[name],
        )
        axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)


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
    of_depth = [shape_of(depth, curves) for curves in log_likelihoods(1.0 / depth, z)]
    of_rho = [shape_of(rho, curves) for curves in log_likelihoods(rho, z)]

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
    draw({"depth [m]": (depth, of_depth), "inverse depth [1/m]": (rho, of_rho)}, out / "mono_depth.png")
    print(f"picture and table in {out}")
    return {"kl_depth": rows[1][3], "kl_inverse": rows[1][4], "kl_depth_end": rows[-1][3]}


if __name__ == "__main__":
    tyro.cli(main)
