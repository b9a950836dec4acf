"""Filter settings common to all systems: particles, likelihood, proposal, resampling."""

from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, Literal

import numpy as np

from rbpf.core.likelihoods import Gaussian, GaussianWithOutliers, StudentT, TruncatedMahalanobis
from rbpf.core.models import Likelihood, Proposal, Resampler
from rbpf.core.proposals import EkfProposal, PriorProposal
from rbpf.core.resampling import EssTriggered, Multinomial, Residual, Stratified, Systematic
from rbpf.ranges import Count, Fraction, Positive, Probability, Range, Ranged, Seed


@dataclass(frozen=True)
class LikelihoodConfig(Ranged):
    """Likelihood of an innovation."""

    #: Gaussian, truncated Mahalanobis (S05 (6)), Gaussian with outliers, or Student's t; by default the system's.
    kind: Literal["gaussian", "truncated", "outliers", "student"] | None = None
    truncation: Positive = 4.0  #: T_l of the truncated form, which bounds the weight.
    #: of the truncated form, squared Mahalanobis distance beyond which a landmark is not updated; 16.3 holds
    #: 99.9 % of a Gaussian in three dimensions.
    update_limit: Positive = 16.3
    outlier_rate: Probability = 0.02  #: outlier probability ε.
    outlier_volume: Annotated[float, Range(gt=0.0, le=1e18)] = 60.0  #: volume V of the measurement space, in its units.
    dof: Positive = 4.0  #: degrees of freedom of Student's t: fewer have heavier tails.

    def build(self) -> Likelihood:
        if self.kind == "truncated":
            return TruncatedMahalanobis(self.truncation, max(self.update_limit, self.truncation))
        if self.kind == "outliers":
            return GaussianWithOutliers(self.outlier_rate, self.outlier_volume)
        return StudentT(self.dof) if self.kind == "student" else Gaussian()


@dataclass(frozen=True)
class ProposalConfig(Ranged):
    """The proposal distribution and the weights."""

    kind: Literal["ekf", "prior"] = "ekf"  #: the motion prior (bootstrap), or the EKF-refined Gaussian (FastSLAM 2.0).
    iterations: Annotated[int, Range(ge=1, le=1000)] = 3  #: linearisations of the refined proposal; 1 is E06.
    #: the exact importance ratio, or E06's linearised joint marginal.
    weights: Literal["exact", "linearised"] = "exact"

    def build(self, start: np.ndarray | None = None) -> Proposal:
        """The proposal, with `start` as of `EkfProposal`; subclasses may return another one."""
        if self.kind == "prior":
            return PriorProposal()
        return EkfProposal(self.weights == "exact", self.iterations, start)


@dataclass(frozen=True)
class ResamplingConfig(Ranged):
    """When and how particles are resampled."""

    scheme: Literal["systematic", "stratified", "residual", "multinomial"] = "systematic"  #: resampling scheme.
    #: resample when the effective sample size falls below this fraction of the particles.
    ess_threshold: Fraction = 0.5

    def build(self) -> Resampler:
        """The resampler; subclasses may return another one."""
        schemes: list[Resampler] = [Systematic(), Stratified(), Residual(), Multinomial()]
        named = {type(scheme).__name__.lower(): scheme for scheme in schemes}
        return EssTriggered(named[self.scheme], self.ess_threshold)


@dataclass(frozen=True)
class RunConfig(Ranged):
    """Settings common to the runs of all systems; a frame is an image, a pair, a step of a robot's log or a scan."""

    particles: Count = 100  #: number of particles.
    seed: Seed = 0  #: seed of all random generators.
    _: KW_ONLY  # a system's own settings are positional, such as dof of a stereo camera
    #: frames of the particles' paths that are kept (of stereo pairs only those that update the filter); None keeps all of a
    #: recording, and the last 150 of a source without a known end. With a joint map only one is kept.
    lag: Count | None = None
    checkpoint_every: Count = 500  #: frames (images, pairs, steps, scans) between checkpoints.
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)  #: when and how particles are resampled.
