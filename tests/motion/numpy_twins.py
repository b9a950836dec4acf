"""What `rbpf.motion.stereo_kernels` computes once more, all matches or all triples at a time."""

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3
from rbpf.motion.stereo_consensus import REFINEMENTS
from rbpf.motion.stereo_geometry import SWEEPS, SWEPT_PX, homography, linearised, reproject, times_pixels
from rbpf.motion.stereo_kernels import FLAT, STIFFNESS


def innovation(matches, delta, points):
    """ν at a motion (7,), with m̂ as `points` says, and L⁻¹ [ν, −∂g/∂ξ] (K, 3, 7)."""
    found = linearised(matches, delta, matches.z_prev, points)
    for _ in range(SWEEPS if points == "adjusted" else 0):
        # m̂ = z⁻ + R⁻ Aᵀ S⁻¹ ν: the linearised problem's minimum.
        nu = np.where(found.seen.front[:, None], found.nu, 0.0)
        gained = found.seen.by_pixels.mT @ np.linalg.solve(found.cov, nu[..., None])
        pixels = matches.z_prev + (matches.cov_prev @ gained)[..., 0]
        change = np.abs(pixels - found.pixels)[found.seen.front].max(initial=0.0)
        found = linearised(matches, delta, pixels, points)
        if change <= SWEPT_PX:
            break
    both = np.concatenate([found.nu[..., None], -found.seen.by_motion], axis=-1)
    both = np.where(found.seen.front[:, None, None], both, 0.0)
    return found, gaussian.solve_lower_matrix(gaussian.cholesky(found.cov), both)


def align(before, now):
    """Motions T (…, 7) with T now = before, for triples of points (…, 3, 3); exact where triangles are congruent."""
    turn = _frame(before) @ _frame(now).mT
    shift = before.mean(axis=-2) - (turn @ now.mean(axis=-2)[..., None])[..., 0]
    return SE3.from_matrix(np.concatenate([turn, shift[..., None]], axis=-1))


def _frame(points):
    edge = _unit(points[..., 1, :] - points[..., 0, :])
    normal = _unit(np.cross(edge, points[..., 2, :] - points[..., 0, :]))
    return np.stack([edge, np.cross(normal, edge), normal], axis=-1)


def _unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), FLAT)


def squared_distances(search, motions, rows):
    """Of some rows (…, k) at motions (…, 7); infinite behind the camera."""
    raised = times_pixels(homography(search.matches.camera, motions), search.matches.z_prev[rows])
    front = raised[..., 3] > 0.0
    seen = raised[..., :3] / np.where(front, raised[..., 3], 1.0)[..., None]
    return np.where(front, np.square(_white_miss(search, seen, rows)).sum(axis=-1), np.inf)


def _white_miss(search, seen, rows):
    return np.einsum("...ij,...j->...i", search.white[rows], search.matches.z_now[rows] - seen)


def proposed(search, rows):
    """Motions (C, 7) of triples (C, 3), and the largest condition of the systems that were solved for them (C,)."""
    aligned = align(search.before[rows], search.now[rows])
    guesses = np.stack([aligned, np.broadcast_to(search.start, aligned.shape)])
    nearer = squared_distances(search, guesses, rows).sum(axis=-1).argmin(axis=0)
    motions, condition = guesses[nearer, np.arange(len(rows))], np.zeros(len(rows))
    for _ in range(REFINEMENTS):
        seen = reproject(search.matches.camera, motions, search.matches.z_prev[rows])
        miss = _white_miss(search, seen.pixels, rows).reshape(len(rows), -1, 1)
        jac = (search.white[rows] @ seen.by_motion).reshape(len(rows), -1, 6)
        info = jac.mT @ jac
        stiff = STIFFNESS * np.trace(info, axis1=1, axis2=2) + np.finfo(float).tiny
        info += stiff[:, None, None] * np.eye(6)
        motions = SE3.retract(motions, np.linalg.solve(info, jac.mT @ miss)[..., 0])
        condition = np.maximum(condition, np.linalg.cond(info))
    return motions, condition
