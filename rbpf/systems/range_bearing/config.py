"""Every setting of a range-bearing run, with its default, its unit and what it does."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from rbpf.core.likelihoods import ExistenceModel, Gates
from rbpf.errors import InputError
from rbpf.ranges import Count, CountOrNone, NotNegative, Positive, Probability, Range, Ranged, Seed, check_ranges
from rbpf.sensors.readers import LogNoise
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig, ResamplingConfig


@dataclass(frozen=True)
class AssociationConfig(Ranged):
    """Unknown association.

    Attributes:
        accept_probability: of the χ² gate within which a landmark may explain an observation.
        isolate_probability: of the χ² gate beyond which an observation may start a landmark.
        new_density: of first observations, in inverse measurement units (1/(m·rad), 1/(m·rad²) or 1/mᵈ).
        clutter_density: of clutter, same units.
        max_range_m: beyond it a landmark is not expected to be seen; None is unlimited.
        half_field_of_view_deg: likewise in yaw.
        hit: added to a landmark's log-odds by an observation.
        miss: subtracted where it was expected and not seen.
        drop: log-odds below which a landmark is deleted.
    """

    accept_probability: Probability = 0.999
    isolate_probability: Probability = 0.999999
    new_density: Positive = 1e-3
    clutter_density: Positive = 1e-4
    max_range_m: Positive | None = None
    half_field_of_view_deg: Annotated[float, Range(gt=0.0, le=180.0)] = 180.0
    hit: NotNegative = 1.0
    miss: NotNegative = 0.0
    drop: float = -2.0

    def gates(self, dim: int) -> Gates:
        """χ² thresholds for measurements of `dim` numbers."""
        from scipy.stats import chi2

        accept, isolate = chi2.ppf([self.accept_probability, self.isolate_probability], dim)
        return Gates(float(accept), float(isolate), np.log(self.new_density), np.log(self.clutter_density))

    def existence(self) -> ExistenceModel:
        return ExistenceModel(hit=self.hit, miss=self.miss, drop=self.drop)


@dataclass(frozen=True)
class RangeBearingConfig:
    """A run of range-bearing SLAM.

    Attributes:
        particles: number of particles.
        seed: of the only random generator.
        association: landmarks named by the log, or by maximum likelihood in each particle.
        map: every particle's own landmarks, each of them a Gaussian given the whole sampled path (particles), or one
            Gaussian of all landmarks and the frame, given the last few steps (joint): an uncertainty that stays true.
        window: of a joint map: steps sampled, at most, before they are taken into it; fewer where the effective sample
            size falls below the threshold of resampling, which does not take place.
        compiled: run the fused kernels; false runs their NumPy twins.
        lag: steps of trajectory kept for smoothing, None keeps all; with a joint map one.
        checkpoint_every: steps between checkpoints.
        anchor_every: steps between re-estimations of where the known start lies in each particle's world; 0 never. A
            joint map needs none: it knows its frame's place.
        noise: standard deviations that replace the log's own.
        proposal: where particles are sampled.
        resampling: when and how.
        likelihood: of an innovation.
        unknown: settings of unknown association.
    """

    particles: Count = 100
    seed: Seed = 0
    association: Literal["known", "ml"] = "known"
    map: Literal["particles", "joint"] = "particles"
    window: Count = 5
    compiled: bool = True
    lag: Count | None = None
    checkpoint_every: Count = 500
    anchor_every: CountOrNone = 10
    noise: LogNoise = field(default_factory=LogNoise)
    proposal: ProposalConfig = field(default_factory=ProposalConfig)
    resampling: ResamplingConfig = field(default_factory=ResamplingConfig)
    likelihood: LikelihoodConfig = field(default_factory=LikelihoodConfig)
    unknown: AssociationConfig = field(default_factory=AssociationConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.map == "joint" and (self.association != "known" or self.likelihood.kind != "gaussian"):
            raise InputError("map=joint takes association=known and likelihood.kind=gaussian: map=particles takes all")
