"""FastSLAM 2.0 as a textbook loop: one Python object per particle, small NumPy arrays, every map copied.

M. Montemerlo, S. Thrun, D. Koller, B. Wegbreit, "FastSLAM 2.0" (2003), with the exact importance ratio and the
look-ahead weight of E06 (10): the same mathematics as `rbpf`, and, with the same random numbers, the same result.
"""

import copy
import math
from dataclasses import dataclass

import numpy as np

from benchmarks.worlds import Frame


@dataclass
class Particle:
    """A pose [theta, x, y] and its own landmarks."""

    pose: np.ndarray
    means: list[np.ndarray]
    covs: list[np.ndarray]


class PlainFastSlam:
    """Planar range-bearing FastSLAM 2.0 with n particles and a prior map of points (M, 2) with a standard deviation."""

    def __init__(self, start: np.ndarray, points: np.ndarray, std: float, n: int, rng: np.random.Generator) -> None:
        cov = std**2 * np.eye(2)
        self.particles = [
            Particle(start.copy(), [p.copy() for p in points], [cov.copy() for _ in points]) for _ in range(n)
        ]
        self.log_weights = np.full(n, -math.log(n))
        self.rng = rng

    def step(self, frame: Frame) -> None:
        """Refine, weigh, resample if the effective sample size is below half, sample, correct, update."""
        root_q = np.linalg.cholesky(frame.control.cov)
        predicted = [moved(particle.pose, frame.control.delta) for particle in self.particles]
        proposals = [
            refined(pose, particle, frame, root_q) for pose, particle in zip(predicted, self.particles, strict=True)
        ]
        log_w1 = np.array([proposal[2] for proposal in proposals])
        self.log_weights = normalised(self.log_weights + log_w1)

        n = len(self.particles)
        ancestors = np.arange(n)
        weights = np.exp(self.log_weights)
        if 1.0 / np.square(weights).sum() < 0.5 * n:
            points = (np.arange(n) + self.rng.random()) / n
            ancestors = np.searchsorted(np.cumsum(weights) / weights.sum(), points, side="right")
            self.log_weights = np.full(n, -math.log(n))
            self.particles = [copy.deepcopy(self.particles[a]) for a in ancestors]

        noise = self.rng.standard_normal((n, 3))
        log_w2 = np.empty(n)
        for i, a in enumerate(ancestors):
            mean, root, w1 = proposals[a]
            u = mean + root @ noise[i]
            particle = self.particles[i]
            particle.pose = moved(predicted[a], exp_se2(root_q @ u))
            log_ratio = 0.5 * (noise[i] @ noise[i] - u @ u) + np.log(np.diag(root)).sum()
            log_w2[i] = updated(particle, frame) + log_ratio - w1
        self.log_weights = normalised(self.log_weights + log_w2)


def normalised(log_weights: np.ndarray) -> np.ndarray:
    high = log_weights.max()
    return log_weights - (high + math.log(np.exp(log_weights - high).sum()))


def exp_se2(xi: np.ndarray) -> np.ndarray:
    angle = xi[0]
    s = math.sin(angle) / angle if abs(angle) > 1e-8 else 1.0
    c = (1.0 - math.cos(angle)) / angle if abs(angle) > 1e-8 else 0.5 * angle
    return np.array([angle, s * xi[1] - c * xi[2], c * xi[1] + s * xi[2]])


def moved(pose: np.ndarray, delta: np.ndarray) -> np.ndarray:
    c, s = math.cos(pose[0]), math.sin(pose[0])
    return np.array([pose[0] + delta[0], pose[1] + c * delta[1] - s * delta[2], pose[2] + s * delta[1] + c * delta[2]])


def linearised(pose: np.ndarray, point: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Innovation, and Jacobians with respect to a right perturbation of the pose and to the landmark."""
    c, s = math.cos(pose[0]), math.sin(pose[0])
    dx, dy = point - pose[1:]
    x, y = c * dx + s * dy, c * dy - s * dx
    r2 = x * x + y * y
    r = math.sqrt(r2)
    turn = z[1] - math.atan2(y, x)
    nu = np.array([z[0] - r, math.atan2(math.sin(turn), math.cos(turn))])
    slope = np.array([[x / r, y / r], [-y / r2, x / r2]])
    jac_pose = slope @ np.array([[y, -1.0, 0.0], [-x, 0.0, -1.0]])
    return nu, jac_pose, slope @ np.array([[c, s], [-s, c]])


def refined(
    pose: np.ndarray, particle: Particle, frame: Frame, root_q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and root of the whitened proposal, and its log-weight."""
    info, vector, quad, log_det = np.zeros((3, 3)), np.zeros(3), 0.0, 0.0
    for landmark, z, noise in zip(frame.ids, frame.z, frame.cov, strict=True):
        nu, jac_pose, jac_map = linearised(pose, particle.means[landmark], z)
        cov = jac_map @ particle.covs[landmark] @ jac_map.T + noise
        inverse = np.linalg.inv(cov)
        info += jac_pose.T @ inverse @ jac_pose
        vector += jac_pose.T @ inverse @ nu
        quad += nu @ inverse @ nu
        log_det += math.log(np.linalg.det(2.0 * math.pi * cov))
    chol = np.linalg.cholesky(np.eye(3) + root_q.T @ info @ root_q)
    root = np.linalg.inv(chol).T
    white = root.T @ (root_q.T @ vector)
    log_w1 = -0.5 * (quad - white @ white + log_det) - np.log(np.diag(chol)).sum()
    return root @ white, root, float(log_w1)


def updated(particle: Particle, frame: Frame) -> float:
    """Kalman updates of the observed landmarks; returns the log-likelihood."""
    total = 0.0
    for landmark, z, noise in zip(frame.ids, frame.z, frame.cov, strict=True):
        nu, _, jac_map = linearised(particle.pose, particle.means[landmark], z)
        cross = jac_map @ particle.covs[landmark]
        cov = cross @ jac_map.T + noise
        gain = np.linalg.solve(cov, cross).T
        particle.means[landmark] = particle.means[landmark] + gain @ nu
        particle.covs[landmark] = particle.covs[landmark] - gain @ cross
        squared = float(nu @ np.linalg.solve(cov, nu))
        total -= 0.5 * (squared + math.log(np.linalg.det(2.0 * math.pi * cov)))
    return total
