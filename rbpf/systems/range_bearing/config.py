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
    """Unknown association."""

    accept_probability: Probability = 0.999  #: of the χ² gate within which a landmark may explain an observation.
    #: of the χ² gate beyond which an observation may start a landmark; of a joint map that of its noise alone.
    isolate_probability: Probability = 0.999999
    #: of first observations, in inverse measurement units (1/(m·rad), 1/(m·rad²) or 1/mᵈ).
    new_density: Positive = 1e-3
    clutter_density: Positive = 1e-4  #: of clutter, same units.
    max_range_m: Positive | None = None  #: beyond it a landmark is not expected to be seen; None is unlimited.
    half_field_of_view_deg: Annotated[float, Range(gt=0.0, le=180.0)] = 180.0  #: likewise in yaw.
    hit: NotNegative = 1.0  #: added to a landmark's log-odds by an observation.
    miss: NotNegative = 0.0  #: subtracted where it was expected and not seen.
    drop: float = -2.0  #: log-odds below which a landmark is deleted.
    #: of a joint map: explanations of all that was measured that are kept side by side, at most.
    hypotheses: Annotated[int, Range(ge=1, le=4)] = 4
    least_weight: Probability = 1e-4  #: below which such an explanation is dropped, or not taken up.

    def gates(self, dim: int) -> Gates:
        """χ² thresholds for measurements of `dim` numbers."""
        accept, isolate = chi_square_quantile([self.accept_probability, self.isolate_probability], dim)
        return Gates(float(accept), float(isolate), np.log(self.new_density), np.log(self.clutter_density))

    def existence(self) -> ExistenceModel:
        return ExistenceModel(hit=self.hit, miss=self.miss, drop=self.drop)


@dataclass(frozen=True)
class CalibrationConfig(Ranged):
    """What a robot that calibrates itself may be wrong about, as standard deviations; 0 is known for certain.

    How far its sensor is from where it is said to be, in the sensor's own directions, and what its wheels get wrong.
    """

    x_m: NotNegative = 0.1  #: ahead.
    y_m: NotNegative = 0.1  #: to the left.
    z_m: NotNegative = 0.1  #: up, in space.
    yaw_deg: NotNegative = 0.0  #: turned to the left.
    heading_deg_per_m: NotNegative = 1.0  #: the odometry's heading drifts for every metre ahead, in the plane.
    turn: NotNegative = 0.05  #: fraction by which its turns are wrong, those to the left and those to the right.
    distance: NotNegative = 0.05  #: fraction by which its distances are wrong; right with calibrate=online.


@dataclass(frozen=True)
class RangeBearingConfig(RunConfig):
    """A run of range-bearing SLAM."""

    #: landmarks named by the log, or by maximum likelihood, in each of some hypotheses: on a joint map.
    association: Literal["known", "ml"] = "known"
    #: one Gaussian of all landmarks and the frame, given the last few steps (joint): an uncertainty that stays true; or
    #: every particle's own landmarks, each of them a Gaussian given the whole sampled path (particles). By default
    #: (auto) joint, but particles where a lag is set.
    map: Literal["auto", "joint", "particles"] = "auto"
    #: of a joint map: steps sampled, at most, before they are taken into it; fewer where the effective sample size
    #: falls below the threshold of resampling, which does not take place. 1 is best where the sensor's place is
    #: estimated, and the default then.
    window: Count = 5
    #: of a joint map: landmarks with which a sub-map ends and the next begins, so that a step costs the same however large
    #: the map becomes; with 20 it ends where it reaches three times as far as the sensor. None keeps one Gaussian of all.
    submap: Count | None = 150
    #: of a joint map of landmarks with names: what is estimated with everything else: in the plane what the wheels get
    #: wrong alike in all steps (odometry), or the sensor's place on the robot (sensor), or both (online; in space
    #: the sensor's place alone). By default (auto) the odometry is taken as it is until what is observed is decidedly off to
    #: one side of it, and from then on as with odometry.
    calibrate: Literal["auto", "off", "odometry", "sensor", "online"] = "auto"
    #: what is known of a robot that calibrates itself.
    self_calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    compiled: bool = True  #: run the fused kernels; false runs their NumPy twins.
    noise: LogNoise = field(default_factory=LogNoise)  #: standard deviations that replace the log's own.
    proposal: ProposalConfig = field(default_factory=ProposalConfig)  #: where particles are sampled.
    #: of an innovation; by default Gaussian. Of a log whose readings may be misread (MRCLAM) with outliers, if the log's
    #: names are used: particles that differ in what no reading tells, as the heading after a blind turn, are else
    #: chosen among by the first wrong one.
    likelihood: LikelihoodConfig = field(default_factory=LikelihoodConfig)
    unknown: AssociationConfig = field(default_factory=AssociationConfig)  #: settings of unknown association.

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Self:
        """The defaults that go with settings that are given, by name: sampled poses tell a calibration more than is known."""
        return cls(window=1) if given.get("calibrate") in ("sensor", "online") else cls()

    def uncertain(self, space: SE2Group | SE3Group) -> np.ndarray:
        """Standard deviations (d + 4,) of what a robot may estimate of itself: its sensor's pose, then `wheel_errors`."""
        of, is_planar = self.self_calibration, isinstance(space, SE2Group)
        yaw, shift = np.deg2rad(of.yaw_deg), (of.x_m, of.y_m, of.z_m)
        sensor = np.array([yaw, *shift[:2]] if is_planar else [0.0, 0.0, yaw, *shift])
        wheels = np.array([np.deg2rad(of.heading_deg_per_m), of.turn, of.turn, of.distance])
        if self.calibrate not in ("sensor", "online"):
            sensor[:] = 0.0
        if self.calibrate in ("off", "sensor") or not is_planar:
            wheels[:] = 0.0
        if self.calibrate == "online":  # who turns one way cannot tell it from a sensor that stands to the side
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
        """The likelihood of an innovation, where readings may be misread or not."""
        robust = misread and self.likelihood.kind is None and self.association == "known"
        return (replace(self.likelihood, kind="outliers") if robust else self.likelihood).build()
