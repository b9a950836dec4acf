"""Visual odometry: the motion of a stereo camera between two frames, from points seen in both (S05 §III-C).

RANSAC on triples separates true from false matches; Levenberg-Marquardt minimises the reprojection error of the inliers,
and the covariance of its solution is that of the motion. Three things differ from the paper's method, which is
`points="exact"`: the earlier points are estimated together with the motion, both images of the later pair are used, and the
covariance includes the earlier points' noise.

`estimate_motion` uses the matches alone; `candidate_motions` also a prior, which it fuses with weaker estimates.
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

ROUNDS = 5  #: Maximum rounds of optimising and reselecting the inliers; they end once the inliers stay the same.
REWEIGHTED = 3  #: Times that S is recomputed for propagated points.
WIDE = 4.0  #: Factor on the gate for the inliers of a triple's motion, which is less exact than one from all matches.
#: Lower bound of the eigenvalues of I − D relative to I: below it the rest cannot be told from noise.
LEAST_KEPT = 0.05
ROUNDING = 1e-14  #: Variances below this fraction of the largest are rounding.


@final
@dataclass(frozen=True)
class VoConfig(Ranged):
    """How a motion is estimated."""

    points: Points = "adjusted"  #: how the earlier points are treated, see `rbpf.motion.stereo_geometry.Points`.
    #: squared Mahalanobis distance beyond which a match is an outlier: the 99 % quantile of χ² with three
    #: degrees of freedom.
    gate: Annotated[float, Range(gt=0.0, le=math.inf)] = 11.345
    min_matches: Annotated[int, Range(ge=3), Formerly("least_matches")] = 8  #: with fewer inliers the estimate fails.
    #: number of triples tried by RANSAC.
    ransac: Annotated[RansacConfig, Formerly("draws")] = field(default_factory=RansacConfig)
    #: stopping criterion of the optimiser; by default a hundredth of the motion's standard deviations.
    rule: Rule = field(default_factory=lambda: Rule(offset=0.01, iterations=100))


@final
@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """The motion between two stereo frames."""

    previous_camera_from_camera: Array  #: (7,) increment; the start if estimation failed.
    cov: Array  #: (6, 6) in the right chart there, order [ω, v]; NaN if estimation failed.
    inliers: np.ndarray  #: (K,) bool, matches that agree with it.
    failure: str = ""  #: why estimation failed; empty on success.
    note: str = ""  #: a remark if the estimate is not from the matches alone; else empty.
    #: further motions supported by matches that are outliers of this one, such as those on a moving object, each with its
    #: own inliers; false matches support none.
    others: tuple["MotionEstimate", ...] = ()

    @property
    def found(self) -> bool:
        """Whether estimation succeeded."""
        return not self.failure

    @property
    def odometry(self) -> Odometry:
        """The increment and its covariance, to hand to a filter."""
        return Odometry(self.previous_camera_from_camera, self.cov)


def estimate_motion(
    matches: Matches, rng: np.random.Generator, start: Array | None = None, config: VoConfig | None = None
) -> MotionEstimate:
    """The motion of a rectified stereo camera between two frames, from `Matches.checked`.

    If there are too few matches or inliers, the estimate's `failure` says so.

    Args:
        matches: of the two frames.
        rng: draws the triples; equal states give bit-identical results.
        start: (7,) a guess of the increment; by default no motion.
        config: settings.
    """
    config, start = config or VoConfig(), SE3.identity() if start is None else np.asarray(start, dtype=float)
    plausible = matches.plausible(config.gate)
    if plausible.sum() < config.min_matches:
        there, count = f"{plausible.sum()} matches are valid", len(matches)
        if count and plausible.mean() < 0.5:
            negative = f"{count - plausible.sum()} of {count} matches have a negative disparity"
            there = f"{negative}: are left and right swapped? {plausible.sum()} are valid"
        return _failed(start, matches, f"{there}, {config.min_matches} are needed")
    motion = consensus(matches.take(plausible), start, config.gate, rng, config.ransac)
    found, squared = _refined(matches, plausible, motion, start, config)
    others, left, last = list[MotionEstimate](), plausible, found
    while last.found:
        # Matches just outside the gate still belong to the previous motion.
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
    """As `estimate_motion`, from a start (7,) that is close enough to classify the matches: no RANSAC."""
    config = config or VoConfig()
    plausible = matches.plausible(config.gate)
    if plausible.sum() < config.min_matches:
        return _failed(start, matches, f"{plausible.sum()} matches are valid, {config.min_matches} are needed")
    return _refined(matches, plausible, start, start, config)[0]


def pixel_gains(matches: Matches, motion: Odometry, config: VoConfig) -> tuple[Array, Array]:
    """Derivatives of an estimate by the pixel noise of its K inliers: Mathematics (vo-gain).

    (K, 6, 3) of the earlier pixels and (K, 6, 3) of the later ones, in the right chart at the estimate.
    """
    pixels = white_rows(matches, motion.delta, "adjusted")[2] if config.points == "adjusted" else matches.z_prev
    cov_nu, seen = linearised(matches, motion.delta, pixels, config.points)
    slope = seen.by_motion
    by_score = np.linalg.solve(cov_nu, slope)
    # K with K I Kᵀ = cov where the estimate is from its matches alone, and K = cov in directions in which a prior
    # contributes. The gains leave out the variance factor of the gate: estimates that share noise are trimmed alike.
    root = gaussian.psd_factor(motion.cov if config.points == "exact" else motion.cov / trimming(config.gate))
    values, axes = np.linalg.eigh(root.T @ np.einsum("kpa,kpb->ab", slope, by_score) @ root)
    half = root @ axes
    later = half / np.sqrt(np.maximum(values, 1.0)) @ half.T @ by_score.mT
    # The paper's earlier points have no noise.
    return np.zeros_like(later) if config.points == "exact" else -later @ seen.by_pixels, later


def fit(matches: Matches, start: Array, config: VoConfig) -> Minimum[Array]:
    """The motion (7,) of least reprojection error near a start, with all matches as inliers."""
    if config.points != "propagated":
        return _minimum(matches, start, config.points, config.rule)
    for _ in range(REWEIGHTED):
        # S at the last motion replaces R and is kept fixed during the optimisation.
        weighted = replace(matches, cov_now=linearised(matches, start, matches.z_prev, "propagated")[0])
        found = _minimum(weighted, start, "exact", config.rule)
        start = found.x
    return found


def _minimum(matches: Matches, start: Array, points: Points, rule: Rule) -> Minimum[Array]:
    return minimise(lambda motion: residuals(matches, motion, points), start, SE3.retract, rule)


def _refined(
    matches: Matches, plausible: np.ndarray, motion: Array, start: Array, config: VoConfig
) -> tuple[MotionEstimate, Array]:
    """The motion refined on its inliers, from an initial one, and squared distances (K,) of all matches from it."""
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
    """Squared distances (K,) of the matches from a motion; for `exact` points the noise is included here."""
    points: Points = "propagated" if config.points == "exact" else config.points
    return squared_distances(matches, motion, points)


def _failed(start: Array, matches: Matches, why: str) -> MotionEstimate:
    return MotionEstimate(start, np.full((6, 6), np.nan), np.zeros(len(matches), dtype=bool), why)


def _consistent_covariance(matches: Matches, motion: Array, factor: Array) -> Array:
    """Covariance (6, 6) of a motion (7,), in the right chart there; `factor` is F with F Fᵀ = I⁻¹.

    The usual answer (JᵀS⁻¹J)⁻¹ at the solution is too small where points are far: the translation's derivative is
    proportional to the inverse depth ρ̂, and E[ρ̂²] exceeds the square of the true ρ by var ρ̂. With the estimated
    information I = Σ JᵀS⁻¹J and D = Σ var ρ̂ (∂J/∂ρ)ᵀS⁻¹(∂J/∂ρ), the derivative of the score is I − D while the score
    itself has the covariance I, because ν is independent of m̂. Hence (W. Fuller 1987, §3.2)

        cov = (I − D)⁻¹ I (I − D)⁻¹,    Mathematics (vo-covariance).
    """
    # ρ = (u_left − u_right) / (f b), of the pixels m̂: cov m̂ = R⁻ − R⁻Aᵀ S⁻¹ A R⁻.
    cov, seen = linearised(matches, motion, white_rows(matches, motion, "adjusted")[2], "adjusted")
    shift = matches.camera.intrinsics[4]
    across = matches.cov_prev @ (np.array([1.0, 0.0, -1.0]) / shift)
    gain = seen.by_pixels @ across[..., None]
    solved = np.linalg.solve(cov, np.concatenate([gain, seen.by_scaled_translation], axis=-1))
    variance = (across[:, 0] - across[:, 2]) / shift - (gain * solved[..., :1]).sum(axis=(1, 2))
    # D is zero except in the translation block.
    d = np.zeros((6, 6))
    scaled = variance[:, None, None] * seen.by_scaled_translation
    d[3:, 3:] = scaled.reshape(-1, 3).T @ solved[..., 1:].reshape(-1, 3)
    noise = factor.T @ d @ factor
    lost, axes = np.linalg.eigh(0.5 * (noise + noise.T))
    half = factor @ axes / np.maximum(1.0 - lost, LEAST_KEPT)
    return half @ half.T


def trimming(gate: float) -> float:
    """Variance factor for gating: of a motion from K inliers, relative to one from K matches not selected by a gate.

    A gate also removes true matches, and those with the largest, most informative residuals: K inliers determine the motion
    less well than K matches that were not selected. The factor is F₃ / F₅, the distributions of χ² with three and five
    degrees of freedom at the gate: rejection by ν has the influence function ν within the gate, the covariance E[νᵀν] / 3 =
    F₅ and the slope F₅ (P. Huber 1981, §4.5), per match, of which the fraction F₃ is within. It equals 3 / E[ν² | within].
    The gate is a squared Mahalanobis distance, infinite for none.
    """
    if math.isinf(gate):
        return 1.0
    three = math.erf(math.sqrt(0.5 * gate)) - math.sqrt(2.0 * gate / math.pi) * math.exp(-0.5 * gate)
    five = three - math.sqrt(2.0 * gate**3 / math.pi) * math.exp(-0.5 * gate) / 3.0
    return three / five


@final
@dataclass(frozen=True)
class MotionPrior(Ranged):
    """The prior of the motion before any match is used: constant velocity, or zero velocity."""

    std_turn: Positive = 1.0  #: standard deviation of the angular velocity about the expected one, rad/s.
    std_speed: Positive = 1.0  #: of the velocity, m/s. Both defaults are a hand-held camera's or an indoor robot's.
    keep_velocity: bool = True  #: whether the expected velocity is the last one estimated, or zero.

    def increment(self, velocity: Array, dt: float) -> Odometry:
        """The increment expected after `dt` seconds at a velocity (6,) [ω, v]."""
        std = dt * np.repeat([self.std_turn, self.std_speed], 3)
        return Odometry(SE3.exp(dt * velocity), np.diag(std**2))


def candidate_motions(
    matches: Matches, expected: Odometry, rng: np.random.Generator, config: VoConfig
) -> tuple[tuple[MotionEstimate, ...], str]:
    """The candidate motions of the camera, that of the first consensus first; else the reason why there is none.

    Usually there is one. Several mean that something in the view moves; the matches do not tell which of them is the
    camera's, so the caller has to decide. Where the matches are weaker than the `expected` motion (only far points, which
    leave the translation open), both are fused, and the motion's `note` says so.
    """
    found = estimate_motion(matches, rng, expected.delta, config)
    motions = (found, *found.others) if found.found else ()
    return tuple(_joined(one, expected) for one in motions), found.failure


def _joined(found: MotionEstimate, expected: Odometry) -> MotionEstimate:
    """The estimate, or if it is weaker in any direction, the product of its Gaussian and the expected one."""
    joined, worst = product(found.odometry, expected)
    if worst <= 1.0:
        return found
    times = f"a standard deviation {np.sqrt(worst):.1f} times the expected one"
    note = f"the matches leave the motion open ({times}); it is joined with the expected one"
    return replace(found, previous_camera_from_camera=joined.delta, cov=joined.cov, note=note)


def product(measured: Odometry, expected: Odometry) -> tuple[Odometry, float]:
    """The fusion of two independent motions; and the largest variance of `measured`, in units of the expected one.

    `expected` has a diagonal covariance. Its `by_constants` is that of `measured`, weighted by its share.
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
