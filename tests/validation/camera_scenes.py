"""Small scenes before a camera, and their batch solution by SciPy in another parametrisation."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from rbpf.lie import SE3, Array
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints, Truth
from tests.validation.worlds import Reference, shrunk, slope_of

PLAIN = Pinhole(640, 480, 400.0, 390.0, 321.0, 243.0)
BENT = replace(PLAIN, distortion=(-0.25, 0.06, 1e-3, -5e-4, 0.0))
WHOLE = replace(PLAIN, distortion=(-0.25, 0.06, 1e-3, -5e-4, 0.02))
FISHEYE = replace(PLAIN, distortion=(-0.03, 0.02, -0.012, 0.002), distortion_model="equidistant")
STEREO = RectifiedStereo(PLAIN, 0.15)
FIRST = SE3.exp(np.array([0.3, -0.2, 1.1, 0.5, -0.7, 0.2]))


def scene(
    camera: Pinhole | RectifiedStereo = PLAIN,
    frames: int = 6,
    points: int = 14,
    known: int = 4,
    seed: int = 0,
    noise_px: float = 1.0,
) -> FeatureLog:
    """A camera moves by a tenth of a metre per frame before points three metres away, of which it sees most.
    Pixels are correlated; the first landmarks are known to a centimetre, in correlated axes."""
    rng = np.random.default_rng(seed)
    path = _walk(frames, rng)
    low, high = [-1.2, -0.9, 2.4], [1.2, 0.9, 4.0]
    places = SE3.transform(path[len(path) // 2], rng.uniform(low, high, (points, 3)))
    names = rng.permutation(np.arange(100, 100 + 3 * points))[:points]
    images = []
    for step, pose in enumerate(path):
        seen = np.flatnonzero((rng.random(points) < 0.9) | (np.arange(points) < known))
        local = SE3.inverse_transform(pose, places[seen])
        factor = noise_px * (
            np.eye(camera.dim) + np.tril(rng.normal(scale=0.3, size=(len(seen), *2 * (camera.dim,))), -1)
        )
        z = camera.project(local) + np.einsum("kij,kj->ki", factor, rng.normal(size=(len(seen), camera.dim)))
        images.append(FeatureFrame(100_000_000 * step, names[seen], z, factor @ factor.mT))
    truth = Truth(np.array([f.stamp_ns for f in images]), path, dict(zip(names.tolist(), places, strict=True)))
    return FeatureLog("small scene", camera, images, _known(names[:known], places[:known], rng), truth)


def _walk(frames: int, rng: np.random.Generator) -> Array:
    path = [FIRST]
    for turn, shift in zip(rng.normal(scale=0.03, size=(frames - 1, 3)), rng.normal(size=(frames - 1, 3)), strict=True):
        step = np.array([0.1, 0.02, 0.03]) + 0.02 * shift
        path.append(SE3.retract(path[-1], np.concatenate([turn, step])))
    return np.array(path)


def _known(names: Array, places: Array, rng: np.random.Generator) -> KnownPoints | None:
    if not len(names):
        return None
    factor = 0.01 * (np.eye(3) + np.tril(rng.normal(scale=0.3, size=(len(names), 3, 3)), -1))
    errors = np.einsum("kij,kj->ki", factor, rng.normal(size=(len(names), 3)))
    return KnownPoints(names, places + errors, factor @ factor.mT)


def solve_by_scipy(log: FeatureLog, robust: float | None = None) -> Reference:
    """Least squares over tangents at the truth; every term is written down once more."""
    names = np.unique(np.concatenate([frame.landmarks for frame in log.frames]))
    steps = np.repeat(np.arange(len(log.frames)), [len(frame.landmarks) for frame in log.frames])
    place = np.searchsorted(names, np.concatenate([frame.landmarks for frame in log.frames]))
    z = np.concatenate([frame.z for frame in log.frames])
    whiten = np.linalg.inv(np.linalg.cholesky(np.concatenate([frame.cov_z for frame in log.frames])))
    fixed, whiten_fixed = (np.searchsorted(names, log.known.names), np.linalg.inv(np.linalg.cholesky(log.known.cov)))
    split = 6 * len(log.frames)
    around = np.array([log.truth.landmarks[name] for name in names.tolist()])

    def parts(x: Array) -> tuple[Array, Array]:
        lead = x.shape[:-1]
        path = SE3.retract(log.truth.poses, x[..., :split].reshape(*lead, -1, 6))
        return path, around + x[..., split:].reshape(*lead, -1, 3)

    def residuals(x: Array) -> Array:
        path, points = parts(x)
        e = log.camera.project(SE3.inverse_transform(path[..., steps, :], points[..., place, :])) - z
        e = shrunk(np.einsum("kij,...kj->...ki", whiten, e), robust)
        prior = np.einsum("kij,...kj->...ki", whiten_fixed, points[..., fixed, :] - log.known.positions)
        return np.concatenate([part.reshape(*x.shape[:-1], -1) for part in (e, prior)], axis=-1)

    x0 = np.zeros(split + around.size)
    found = least_squares(
        residuals, x0, lambda x: slope_of(residuals, x), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    return Reference.of(found, slope_of(residuals, found.x), SE3, lambda x: parts(x)[0], parts(found.x)[1])
