"""Visual odometry: how a stereo camera has moved between two frames, from points seen in both (S05 §III-C).

A consensus of triples separates true from false matches; Levenberg-Marquardt on the reprojection error of those that
agree finds the motion, and what they leave open about it is its covariance. In three respects this is not the paper's
method, which `points="exact"` gives: the earlier points are estimated together with the motion, both images of the
later pair count, and the covariance includes the earlier points' noise.

`estimate_motion` looks at the matches alone; `candidate_motions` starts from a prior, and joins with it what says less.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, final

import numpy as np

from rbpf import gaussian
from rbpf.lie import SE3, Array
from rbpf.motion.least_squares import Minimum, Rule, minimise
from rbpf.motion.odometry import Odometry
from rbpf.motion.stereo_consensus import RansacConfig, consensus
from rbpf.motion.stereo_geometry import Matches, Points, linearised, residuals, squared_distances, white_rows
from rbpf.ranges import Formerly, Positive, Range, Ranged

ROUNDS = 5  #: Of optimising and choosing anew which matches agree; it ends when they stay the same.
REWEIGHTED = 3  #: Times that S is formed anew for propagated points.
WIDE = 4.0  #: Times the gate is what agrees with the consensus of three: it is not yet the motion of all.
#: No direction keeps less of I than this in I − D: where nearly all is noise, what is left cannot be told from it.
LEAST_KEPT = 0.05
ROUNDING = 1e-14  #: Variances below this fraction of the largest are rounding.


@final
@dataclass(frozen=True)
class VoConfig(Ranged):
    """How a motion is estimated."""

    points: Points = "adjusted"  #: what the earlier points are taken for, see `rbpf.motion.stereo_geometry.Points`.
    #: squared Mahalanobis distance beyond which a match is false; 99 % of the true ones are within, χ² with three
    #: degrees of freedom.
    gate: Annotated[float, Range(gt=0.0, le=math.inf)] = 11.345
    min_matches: Annotated[int, Range(ge=3), Formerly("least_matches")] = 8  #: fewer that agree are no motion.
    #: how many triples are tried.
    ransac: Annotated[RansacConfig, Formerly("draws")] = field(default_factory=RansacConfig)
    #: when the optimiser stops; the default is a hundredth of the motion's standard deviations.
    rule: Rule = field(default_factory=lambda: Rule(offset=0.01, iterations=100))


@final
@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """The motion between two stereo frames."""

    previous_camera_from_camera: Array  #: (7,) increment; the start where none was found.
    cov: Array  #: (6, 6) in the right chart there, order [ω, v]; NaN where none was found.
    inliers: np.ndarray  #: (K,) bool, matches that agree with it.
    failure: str = ""  #: why no motion was found, in words; empty where one was.
    note: str = ""  #: in words, where it is not simply what the matches say; empty else.
    #: motions that matches far from this one agree on, as those on a thing that moves, each with its own inliers; false
    #: matches agree on none.
    others: tuple["MotionEstimate", ...] = ()

    @property
    def found(self) -> bool:
        """Whether there is a motion."""
        return not self.failure

    @property
    def odometry(self) -> Odometry:
        """The increment and its covariance, to hand to a filter."""
        return Odometry(self.previous_camera_from_camera, self.cov)


def estimate_motion(
    matches: Matches, rng: np.random.Generator, start: Array | None = None, config: VoConfig | None = None
) -> MotionEstimate:
    """The motion of a rectified stereo camera between two frames, from their `Matches.checked`.

    Where matches are too few or do not agree, the estimate's `failure` says so.

    Args:
        matches: of the two frames.
        rng: draws the triples; the same state gives the same bytes.
        start: (7,) a guess of the increment; by default the camera stands still.
        config: how.
    """
    config, start = config or VoConfig(), SE3.identity() if start is None else np.asarray(start, dtype=float)
    plausible = matches.plausible(config.gate)
    if plausible.sum() < config.min_matches:
        there, count = f"{plausible.sum()} matches are there", len(matches)
        if count and plausible.mean() < 0.5:
            negative = f"{count - plausible.sum()} of {count} matches have a negative disparity"
            there = f"{negative}: are left and right swapped? {plausible.sum()} are left"
        return _failed(start, matches, f"{there}, {config.min_matches} are needed")
    motion = consensus(matches.take(plausible), start, config.gate, rng, config.ransac)
    found, squared = _refined(matches, plausible, motion, start, config)
    others, left, last = list[MotionEstimate](), plausible, found
    while last.found:
        # Matches just outside a gate belong to the motion that was found first.
        left = left & (squared > WIDE * config.gate)
        if left.sum() < config.min_matches:
            break
        far, inliers = matches.take(left), np.zeros(len(matches), dtype=bool)
        motion = consensus(far, SE3.identity(), config.gate, rng, config.ransac)
        last, squared[left] = _refined(far, np.ones(len(far), dtype=bool), motion, motion, config)
        inliers[np.flatnonzero(left)[last.inliers]] = True
        if last.found:
            last = replace(last, inliers=inliers)
            others.append(last)
    return replace(found, others=tuple(others))


def refine_motion(matches: Matches, start: Array, config: VoConfig | None = None) -> MotionEstimate:
    """As `estimate_motion`, near a motion (7,) that is known well enough to tell which matches are false."""
    config = config or VoConfig()
    plausible = matches.plausible(config.gate)
    if plausible.sum() < config.min_matches:
        return _failed(start, matches, f"{plausible.sum()} matches are there, {config.min_matches} are needed")
    return _refined(matches, plausible, start, start, config)[0]


def pixel_gains(matches: Matches, motion: Odometry, config: VoConfig) -> tuple[Array, Array]:
    """By what noise of the pixels moves an estimate, of the K matches that agree with it: Mathematics (vo-gain).

    (K, 6, 3) of the earlier pixels and (K, 6, 3) of the later ones, in the right chart at the estimate.
    """
    pixels = white_rows(matches, motion.delta, "adjusted")[2] if config.points == "adjusted" else matches.z_prev
    cov_nu, seen = linearised(matches, motion.delta, pixels, config.points)
    slope = seen.by_motion
    by_score = np.linalg.solve(cov_nu, slope)
    # K with K I Kᵀ = cov, where the estimate is its matches' alone, and K = cov in directions in which a prior has its say.
    # What the gate costs is in the covariance, not in the gains: of noise in two estimates both cut off their part.
    root = gaussian.psd_factor(motion.cov if config.points == "exact" else motion.cov / trimming(config.gate))
    values, axes = np.linalg.eigh(root.T @ np.einsum("kpa,kpb->ab", slope, by_score) @ root)
    half = root @ axes
    later = half / np.sqrt(np.maximum(values, 1.0)) @ half.T @ by_score.mT
    # The paper's earlier points have no noise.
    return np.zeros_like(later) if config.points == "exact" else -later @ seen.by_pixels, later


def fit(matches: Matches, start: Array, config: VoConfig) -> Minimum[Array]:
    """The motion (7,) of least reprojection error near a start, all matches taken as true."""
    if config.points != "propagated":
        return _minimum(matches, start, config.points, config.rule)
    for _ in range(REWEIGHTED):
        # S as it is at the last motion takes the place of R, and stays while the motion is sought.
        weighted = replace(matches, cov_now=linearised(matches, start, matches.z_prev, "propagated")[0])
        found = _minimum(weighted, start, "exact", config.rule)
        start = found.x
    return found


def _minimum(matches: Matches, start: Array, points: Points, rule: Rule) -> Minimum[Array]:
    return minimise(lambda motion: residuals(matches, motion, points), start, SE3.retract, rule)


def _refined(
    matches: Matches, plausible: np.ndarray, motion: Array, start: Array, config: VoConfig
) -> tuple[MotionEstimate, Array]:
    """The motion of all matches that agree, from one that many agree with, and squared distances (K,) of all from it."""
    squared, iterations = _squared(matches, motion, config), 0
    agreeing = plausible & (squared <= WIDE * config.gate)
    for _ in range(ROUNDS):
        if agreeing.sum() < config.min_matches:
            agree = f"{agreeing.sum()} of {len(matches)} matches agree on a motion"
            return _failed(start, matches, f"{agree}, {config.min_matches} are needed"), squared
        inliers, part = agreeing, matches.take(agreeing)
        found = fit(part, motion, config)
        motion, iterations = found.x, iterations + found.iterations
        squared = _squared(matches, motion, config)
        agreeing = plausible & (squared <= config.gate)
        if (agreeing == inliers).all():
            break
    if not found.converged:
        return _failed(start, matches, f"the optimiser did not converge in {iterations} iterations"), squared
    cov = _consistent_covariance(part, motion, found.factor) if config.points == "adjusted" else found.cov
    if config.points != "exact":
        cov = trimming(config.gate) * cov
    return MotionEstimate(motion, cov, inliers), squared


def _squared(matches: Matches, motion: Array, config: VoConfig) -> Array:
    """Squared distances (K,) of the matches from a motion; the paper's points have no noise, but their matches do."""
    points: Points = "propagated" if config.points == "exact" else config.points
    return squared_distances(matches, motion, points)


def _failed(start: Array, matches: Matches, why: str) -> MotionEstimate:
    return MotionEstimate(start, np.full((6, 6), np.nan), np.zeros(len(matches), dtype=bool), why)


def _consistent_covariance(matches: Matches, motion: Array, factor: Array) -> Array:
    """Covariance (6, 6) of a motion (7,), in the right chart there; `factor` is F with F Fᵀ = I⁻¹.

    (JᵀS⁻¹J)⁻¹ at the solution is the usual answer, and too small where points are far: the translation's derivative is
    proportional to the inverse depth ρ̂, and the square of a noisy ρ̂ is larger than that of the true one by var ρ̂, on
    average. With the information I = Σ JᵀS⁻¹J as found and D = Σ var ρ̂ (∂J/∂ρ)ᵀS⁻¹(∂J/∂ρ), the derivative of the
    score is I − D while the score itself has the covariance I, because ν is independent of m̂. Hence (W. Fuller 1987,
    §3.2)

        cov = (I − D)⁻¹ I (I − D)⁻¹,    Mathematics (vo-covariance).
    """
    # ρ = (u_left − u_right) / (f b), of the pixels m̂: cov m̂ = R⁻ − R⁻Aᵀ S⁻¹ A R⁻.
    cov, seen = linearised(matches, motion, white_rows(matches, motion, "adjusted")[2], "adjusted")
    shift = matches.camera.intrinsics[4]
    across = matches.cov_prev @ (np.array([1.0, 0.0, -1.0]) / shift)
    gain = seen.by_pixels @ across[..., None]
    solved = np.linalg.solve(cov, np.concatenate([gain, seen.by_scaled_translation], axis=-1))
    variance = (across[:, 0] - across[:, 2]) / shift - (gain * solved[..., :1]).sum(axis=(1, 2))
    # D is zero but for the translation.
    d = np.zeros((6, 6))
    scaled = variance[:, None, None] * seen.by_scaled_translation
    d[3:, 3:] = scaled.reshape(-1, 3).T @ solved[..., 1:].reshape(-1, 3)
    noise = factor.T @ d @ factor
    lost, axes = np.linalg.eigh(0.5 * (noise + noise.T))
    half = factor @ axes / np.maximum(1.0 - lost, LEAST_KEPT)
    return half @ half.T


def trimming(gate: float) -> float:
    """Variance of a motion from the matches within a gate, beside that from as many that were not chosen.

    Leaving out what lies beyond a gate costs true matches, and the farthest, which speak most: the rest determines the
    motion less well than as many that were not chosen would. F₃ / F₅, the distributions of χ² with three and five
    degrees of freedom at the gate: rejection by ν has the influence function ν within the gate, the covariance
    E[νᵀν] / 3 = F₅ and the slope F₅ (P. Huber 1981, §4.5), for each match; the fraction F₃ of them is within. It is
    also 3 / E[ν² | within]. The gate is a squared Mahalanobis distance, infinite for none.
    """
    if math.isinf(gate):
        return 1.0
    three = math.erf(math.sqrt(0.5 * gate)) - math.sqrt(2.0 * gate / math.pi) * math.exp(-0.5 * gate)
    five = three - math.sqrt(2.0 * gate**3 / math.pi) * math.exp(-0.5 * gate) / 3.0
    return three / five


@final
@dataclass(frozen=True)
class MotionPrior(Ranged):
    """The motion that is expected before anything is seen: the last velocity, or standing still."""

    std_turn: Positive = 1.0  #: standard deviation of the angular velocity about the expected one, rad/s.
    std_speed: Positive = 1.0  #: of the velocity, m/s. Both defaults are a hand-held camera's or an indoor robot's.
    keep_velocity: bool = True  #: whether the last velocity that was seen is expected to go on.

    def increment(self, velocity: Array, dt: float) -> Odometry:
        """The increment expected after `dt` seconds at a velocity (6,) [ω, v]."""
        std = dt * np.repeat([self.std_turn, self.std_speed], 3)
        return Odometry(SE3.exp(dt * velocity), np.diag(std**2))


def candidate_motions(
    matches: Matches, expected: Odometry, rng: np.random.Generator, config: VoConfig
) -> tuple[tuple[MotionEstimate, ...], str]:
    """The motions that the matches may tell of, that of the first consensus first; else, in words, why there is none.

    One is the rule. Several mean that something in the view moves: which of them is the camera's is not in the matches,
    and is for the caller to say. Where they tell less than what is `expected` before anything is seen (nothing but far
    points: how far did the camera go?) both are joined, and a motion's `note` says so.
    """
    found = estimate_motion(matches, rng, expected.delta, config)
    motions = (found, *found.others) if found.found else ()
    return tuple(_joined(one, expected) for one in motions), found.failure


def _joined(found: MotionEstimate, expected: Odometry) -> MotionEstimate:
    """The estimate, or in case it is the weaker one anywhere, the product of its Gaussian and the expected one."""
    joined, worst = product(found.odometry, expected)
    if worst <= 1.0:
        return found
    times = f"a standard deviation {np.sqrt(worst):.1f} times the expected one"
    note = f"the matches leave the motion open ({times}); it is joined with the expected one"
    return replace(found, previous_camera_from_camera=joined.delta, cov=joined.cov, note=note)


def product(measured: Odometry, expected: Odometry) -> tuple[Odometry, float]:
    """What both say, their errors being independent; and the largest variance of `measured`, where the expected one is 1.

    `expected` has a diagonal covariance. The product moves with constants as much as `measured` has a say in it.
    """
    # In units of the expected standard deviations the expected covariance is I.
    std = np.sqrt(np.diagonal(expected.cov))
    values, axes = np.linalg.eigh(measured.cov / np.outer(std, std))
    values = np.maximum(values, ROUNDING * values[-1])
    off = axes.T @ (SE3.local(expected.delta, measured.delta) / std)
    half = std[:, None] * axes * np.sqrt(values / (1.0 + values))
    joined = SE3.retract(expected.delta, std * (axes @ (off / (1.0 + values))))
    slope = measured.by_constants
    if slope is not None:
        slope = std[:, None] * (axes / (1.0 + values)) @ axes.T @ (slope / std[:, None])
    return Odometry(joined, half @ half.T, slope), float(values[-1])
