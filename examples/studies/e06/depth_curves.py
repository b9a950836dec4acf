"""Likelihood of a landmark's depth after some observations, on a grid, without linearisation (figure 2)."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rbpf.lie import SE3
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraRay

SHOWN = 1, 2, 3, 5, 10
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple")


class Prediction(NamedTuple):
    """Predictions of K later observations for each depth of a grid.

    Attributes:
        px: (G, 2K), pixels of points on the ray through the first pixel.
        chol: (G, 2K, 2K) of the covariance, including the first observation's noise.
    """

    px: np.ndarray
    chol: np.ndarray


@dataclass(frozen=True)
class Passing:
    """A camera that passes a point.

    Attributes:
        camera: of the observations.
        poses: (K, 7) first_camera_from_camera of the later observations.
        std_px: noise of each observation, per axis.
    """

    camera: Pinhole
    poses: np.ndarray
    std_px: float

    def predict(self, first_px: np.ndarray, rho: np.ndarray) -> Prediction:
        """Observations of points at inverse depths (G,) on the ray through the first pixel (2,)."""
        ray, count = CameraRay(self.camera), 2 * len(self.poses)
        uv = np.broadcast_to(self.camera.unproject(first_px[None]), (len(rho), 2))
        landmark = np.concatenate([uv, rho[:, None]], axis=1)[:, None]
        px = ray.predict(self.poses, landmark, SE3.identity())
        slopes = ray.jacobians(self.poses, landmark, SE3.identity()).landmark
        assert slopes is not None
        slope = slopes[..., :2].reshape(len(rho), -1, 2)
        moved = slope @ (self.std_px * self.camera.unproject_jacobian(first_px[None])[0])
        cov = moved @ np.swapaxes(moved, 1, 2) + self.std_px**2 * np.eye(count)
        return Prediction(px.reshape(len(rho), -1), np.linalg.cholesky(cov))

    def log_likelihoods(self, first_px: np.ndarray, rho: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Log-likelihoods (K, R, G) of inverse depths (G,) after each of K observations, for R repetitions of pixels (R, 2K).

        The first rows of a Cholesky factor are the factor of the first rows: one solution serves any number of
        observations.
        """
        expected = self.predict(first_px, rho)
        white = np.linalg.solve(expected.chol, np.moveaxis(z[:, None] - expected.px, 0, -1))
        scale = np.log(np.diagonal(expected.chol, axis1=1, axis2=2))[..., None]
        return np.moveaxis(-np.cumsum(0.5 * white**2 + scale, axis=1)[:, 1::2], 0, -1)


class Shape(NamedTuple):
    """Curves (R, G) over a grid, and their differences from a Gaussian (R,)."""

    density: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    divergence: np.ndarray
    skewness: np.ndarray


def shape_of(grid: np.ndarray, log_density: np.ndarray) -> Shape:
    """Normalises; computes moments and the Kullback-Leibler divergence from the Gaussian of these moments, in nats."""
    cell = np.gradient(grid)
    density = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    density /= (density @ cell)[:, None]
    mean = density @ (grid * cell)
    offset = grid - mean[:, None]
    std = np.sqrt((density * offset**2) @ cell)
    gaussian = -0.5 * (offset / std[:, None]) ** 2 - np.log(np.sqrt(2.0 * np.pi) * std)[:, None]
    log_ratio = np.log(np.maximum(density, np.finfo(float).tiny)) - gaussian
    return Shape(density, mean, std, (density * log_ratio) @ cell, (density * offset**3) @ cell / std**3)


def draw_curves(curves: dict[str, tuple[np.ndarray, list[Shape]]], true_depth_m: float) -> Any:
    """Plots the first repetition's curves over depth and inverse depth: grids (G,) and shapes by name of the axis.

    Args:
        curves: "depth [m]" and "inverse depth [1/m]", each with a shape for every number of observations.
        true_depth_m: marked in the plot.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    limits = {"depth [m]": (0.0, 4.0 * true_depth_m), "inverse depth [1/m]": (0.0, 2.6 / true_depth_m)}
    for axes, (name, (grid, shapes)) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        for colour, observations in zip(COLOURS, SHOWN, strict=True):
            _draw_curve(
                axes, grid, shapes[observations - 1], colour, f"{observations} observation{'s' * (observations > 1)}"
            )
        true = true_depth_m if name.startswith("depth") else 1.0 / true_depth_m
        axes.axvline(true, color="black", lw=0.8, ls="--", label="truth")
        quantity = name.split(" [")[0]
        axes.set(title=f"likelihood of {quantity}", xlabel=name, ylabel="relative to its peak", xlim=limits[name])
        axes.legend(fontsize="small")
    return figure


def _draw_curve(axes: Any, grid: np.ndarray, shape: Shape, colour: str, name: str) -> None:
    """A density and, dotted, the Gaussian with its mean and variance."""
    peak = shape.density[0].max()
    axes.plot(grid, shape.density[0] / peak, color=colour, label=name)
    deviation = (grid - shape.mean[0]) / shape.std[0]
    height = 1.0 / (np.sqrt(2.0 * np.pi) * shape.std[0] * peak)
    axes.plot(grid, height * np.exp(-0.5 * deviation**2), ":", color=colour, lw=1.2)
