"""Every setting of a range-bearing run, with its default, its unit and what it does."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, Self

import numpy as np

from rbpf.core.diagnostics import chi_square_quantile
from rbpf.core.likelihoods import ExistenceModel, Gates
from rbpf.core.models import Likelihood
from rbpf.lie import SE2Group, SE3Group
from rbpf.ranges import Count, NotNegative, Positive, Probability, Range, Ranged
from rbpf.sensors.readers import LogNoise
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig, RunConfig


@dataclass(frozen=True)
class AssociationConfig(Ranged):
    """Unknown data association."""

    accept_probability: Probability = 0.999  #: probability of the χ² gate for a landmark's observations.
    #: probability of the χ² gate beyond which, for all landmarks, an observation may be of a new one; with a joint map the
    #: gate is of the noise alone.
    isolate_probability: Probability = 0.999999
    #: density of first observations, in inverse measurement units (1/(m·rad), 1/(m·rad²) or 1/mᵈ).
    new_density: Positive = 1e-3
    clutter_density: Positive = 1e-4  #: of clutter, same units.
    max_range_m: Positive | None = None  #: beyond it a landmark is not expected to be observed; None is unlimited.
    half_field_of_view_deg: Annotated[float, Range(gt=0.0, le=180.0)] = 180.0  #: likewise in yaw.
    hit: NotNegative = 1.0  #: added to a landmark's log-odds by an observation.
    miss: NotNegative = 0.0  #: subtracted if the landmark was expected and not observed.
    drop: float = -2.0  #: log-odds below which a landmark is deleted.
    #: for a joint map: maximum number of association hypotheses.
    hypotheses: Annotated[int, Range(ge=1, le=4)] = 4
    least_weight: Probability = 1e-4  #: weight below which a hypothesis is dropped or not started.

    def gates(self, dim: int) -> Gates:
        """χ² thresholds for measurements of `dim` numbers."""
        accept, isolate = chi_square_quantile([self.accept_probability, self.isolate_probability], dim)
        return Gates(float(accept), float(isolate), np.log(self.new_density), np.log(self.clutter_density))

    def existence(self) -> ExistenceModel:
        return ExistenceModel(hit=self.hit, miss=self.miss, drop=self.drop)


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """Priors of a robot's self-calibration, as standard deviations; 0 means known exactly.

    They are of the sensor's given mounting pose, in the sensor's axes, and of systematic odometry errors.
    """

    x_m: NotNegative = 0.1  #: mounting position, ahead.
    y_m: NotNegative = 0.1  #: mounting position, to the left.
    z_m: NotNegative = 0.1  #: mounting position, up, in space.
    yaw_deg: NotNegative = 0.0  #: mounting yaw, to the left.
    heading_deg_per_m: NotNegative = 1.0  #: heading drift per metre ahead, in the plane.
    turn: NotNegative = 0.05  #: relative error of rotations, separately to the left and to the right.
    distance: NotNegative = 0.05  #: relative error of distances; with calibrate=online they are exact.


@dataclass(frozen=True)
class RangeBearingConfig(RunConfig):
    """A run of range-bearing SLAM."""

    #: known association by the log's names, or maximum likelihood in several hypotheses on a joint map.
    association: Literal["known", "ml"] = "known"
    #: joint: one Gaussian of all landmarks and the frame, given the last few steps, which stays consistent. particles:
    #: per-particle landmarks, Gaussians given the whole sampled path. auto: joint, but particles if a lag is set.
    map: Literal["auto", "joint", "particles"] = "auto"
    #: for a joint map: number of steps sampled before they are merged into it. Below the effective sample size of the
    #: resampling threshold they are merged earlier, instead of resampling. If the sensor's mounting pose is estimated, 1 is
    #: best, and the default.
    window: Count = 5
    #: for a joint map: maximum number of landmarks of a sub-map, which bounds the cost of a step however large the map
    #: becomes. From 20 landmarks on, it also ends at an extent of three times the sensor's range. None: one Gaussian of all.
    submap: Count | None = 150
    #: for a joint map with known association: self-calibration together with the map. odometry: systematic odometry errors,
    #: in the plane. sensor: the sensor's mounting pose. online: both; in space only the mounting pose. auto: odometry is
    #: assumed unbiased until observations show a significant systematic error, and from then on as with odometry.
    calibrate: Literal["auto", "off", "odometry", "sensor", "online"] = "auto"
    #: priors of the self-calibration.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    compiled: bool = True  #: run the fused kernels; false runs their NumPy twins.
    noise: LogNoise = field(default_factory=LogNoise)  #: standard deviations that replace the log's own.
    proposal: ProposalConfig = field(default_factory=ProposalConfig)  #: the proposal distribution.
    #: likelihood of an innovation: by default Gaussian, or with outliers for logs with wrong associations (MRCLAM), if the
    #: log's names are used. Otherwise the first wrong association would select among particles that differ in unobserved
    #: directions, such as the heading after driving without observations.
    likelihood: LikelihoodConfig = field(default_factory=LikelihoodConfig)
    unknown: AssociationConfig = field(default_factory=AssociationConfig)  #: settings of unknown association.

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Self:
        """The defaults given other settings by name: sampled poses make a calibration overconfident, so its window is 1."""
        return cls(window=1) if given.get("calibrate") in ("sensor", "online") else cls()

    def uncertain(self, space: SE2Group | SE3Group) -> np.ndarray:
        """Standard deviations (d + 4,) of the calibration parameters: the mounting pose's, then `wheel_errors`."""
        of, is_planar = self.self_calibration, isinstance(space, SE2Group)
        yaw, shift = np.deg2rad(of.yaw_deg), (of.x_m, of.y_m, of.z_m)
        sensor = np.array([yaw, *shift[:2]] if is_planar else [0.0, 0.0, yaw, *shift])
        wheels = np.array([np.deg2rad(of.heading_deg_per_m), of.turn, of.turn, of.distance])
        if self.calibrate not in ("sensor", "online"):
            sensor[:] = 0.0
        if self.calibrate in ("off", "sensor") or not is_planar:
            wheels[:] = 0.0
        if self.calibrate == "online":  # with rotations to one side it is not separable from a lateral sensor offset
            wheels[-1] = 0.0
        return np.concatenate([sensor, wheels])

    def kept_map(self) -> tuple[Literal["joint", "particles"], str]:
        """The map of a run, and in one sentence why it is this one."""
        if self.map != "auto":
            return self.map, f"The map is as asked for: map={self.map}."
        if self.lag is None:
            return "joint", "All landmarks and the robot are one Gaussian (map=joint)."
        return (
            "particles",
            "Every particle has its own landmarks (map=particles): a lag asks for the paths of particles.",
        )

    def of_innovations(self, misread: bool) -> Likelihood:
        """The likelihood of an innovation; `misread`: associations of the log may be wrong."""
        robust = misread and self.likelihood.kind is None and self.association == "known"
        return (replace(self.likelihood, kind="outliers") if robust else self.likelihood).build()
