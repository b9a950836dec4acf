"""Range-bearing SLAM in the plane and in space: odometry, a mounted sensor, point landmarks, FastSLAM 2.0.

`RangeBearingSlam(RangeBearingConfig(particles=100))` processes a log entry by `track(z, cov_z, names, odometry, stamp_ns)`.
"""

from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.core.checkpoint import elements, integers, numbers, read_one, taken
from rbpf.core.diagnostics import motion_correction
from rbpf.core.models import NULL
from rbpf.errors import InputError
from rbpf.lie import SE2, SE2Group, SE3Group
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition, RigidPointModel
from rbpf.sensors.readers import Frame, RobotLog
from rbpf.sensors.readers.measurements import Kind, Measurements
from rbpf.systems.map_estimate import MapEstimate, estimate_map
from rbpf.systems.range_bearing.calibration import RobotCalibration
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.hypotheses import HYPOTHESES, Hypotheses
from rbpf.systems.system import FILTER_COLUMNS, Column, FrameLog, Ragged, System, Tracked, TrackingState, filter_values


@final
class RangeBearingSlam(System):
    """A robot with odometry among point landmarks; it starts at the origin of the world.

    Args:
        config: all settings.
        space: SE2 or SE3, group of the robot's poses.
        measurement: "range_bearing" (range, yaw[, pitch]) or "position" (point in the sensor's frame).
        robot_from_sensor: (E,) mounting pose of the sensor; by default the robot's own frame.
        pitch_sign: +1 where positive pitch points up, −1 where it points down.
        keep_associations: store the association of every hypothesis, until the end of the run decides which one survives; its
            memory grows with the run.
        misread: whether given associations may be wrong.
    """

    name: ClassVar[str] = "range-bearing"
    frame_word: ClassVar[str] = "step"
    config: RangeBearingConfig

    def __init__(
        self,
        config: RangeBearingConfig | None = None,
        space: SE2Group | SE3Group = SE2,
        measurement: Kind = "range_bearing",
        robot_from_sensor: np.ndarray | None = None,
        pitch_sign: float = 1.0,
        keep_associations: bool = False,
        misread: bool = False,
    ) -> None:
        self.config = config = config or RangeBearingConfig()
        self.space, self.measurement, self.pitch_sign = space, measurement, pitch_sign
        self.robot_from_sensor = space.identity() if robot_from_sensor is None else robot_from_sensor
        unknown = config.unknown
        max_range = np.inf if unknown.max_range_m is None else unknown.max_range_m
        mount, view = self.robot_from_sensor, np.deg2rad(unknown.half_field_of_view_deg)
        self.model: RigidPointModel = RangeBearing(space, mount, pitch_sign, max_range, view)
        if measurement == "position":
            self.model = RelativePosition(space, mount, max_range)
        self.point = Point(space.point_dim)
        self.kept_map, self.why_map = config.kept_map()
        is_joint, is_unnamed = self.kept_map == "joint", config.association == "ml"
        if is_unnamed and not is_joint:
            raise InputError(
                "association=ml needs a joint map: leave out map=particles and lag; in a program, a filter with an "
                "AnonymousLandmarkSensor associates in every particle"
            )
        landmark_map: JointMap | LandmarkMap
        self.calibration = calibration = RobotCalibration(config, space, self.model, is_joint and not is_unnamed)
        if is_joint:
            common = space, calibration.prior, config.compiled, config.submap
            unnamed = is_unnamed and config.submap is not None
            landmark_map = JointMap(*common, unnamed=unnamed, constants=calibration.learnt.size)
        else:
            landmark_map = LandmarkMap(space, compiled=config.compiled)
            landmark_map.register(self.point)
        self.likelihood = likelihood = config.of_innovations(misread)  #: of an innovation.
        self.sensor = sensor = NamedLandmarkSensor(self.model, self.point, likelihood)
        motion = OdometryMotion(space, constants=calibration.learnt.size)
        self.filter = self.new_filter(motion, sensor, [landmark_map], config.proposal.build(), config.window)
        self.hypotheses = Hypotheses(self.filter, self.model, unknown, keep_associations) if is_unnamed else None
        self._odometry = space.identity()
        d, e, p = space.dim, space.size, self.model.dim
        self.columns = (
            *FILTER_COLUMNS,
            *([] if self.hypotheses is None else [HYPOTHESES]),
            Column(
                "correction", "correction of the motion by the observations, in its whitened coordinates", shape=(d,)
            ),
            Column("cov_correction", "covariance of the correction in a consistent filter", shape=(d, d)),
            Column("odometry", "world_from_robot by odometry alone", shape=(e,)),
            Column("delta", "odometry, previous_robot_from_robot; NaN in the first frame", shape=(e,)),
            Column("cov_delta", "its covariance in the right chart", "rad² and m²", shape=(d, d)),
        )
        self.observed = (
            Ragged("landmarks", "name of each observation's landmark, −1 where it was not used", kind="int64"),
            Ragged("z", "measurements", (p,), per="landmarks"),
            Ragged("cov_z", "their covariance", (p, p), per="landmarks"),
        )

    @classmethod
    def of_log(
        cls, log: RobotLog, config: RangeBearingConfig | None = None, keep_associations: bool = False
    ) -> "RangeBearingSlam":
        """The system for the robot and the sensor of a log."""
        kind: Kind = "position" if log.measurement == "position" else "range_bearing"
        return cls(config, log.space, kind, log.robot_from_sensor, log.pitch_sign, keep_associations, log.misread)

    def track(
        self,
        z: ArrayLike,
        cov_z: ArrayLike,
        landmarks: ArrayLike | None = None,
        odometry: Odometry | None = None,
        stamp_ns: int | None = None,
    ) -> Tracked:
        """One step: the motion since the last one, and the observations after it.

        Args:
            z: (K, p) measurements.
            cov_z: (K, p, p) their covariance.
            landmarks: (K,) names; None, or −1, for unknown association.
            odometry: motion since the last step; None in the first one.
            stamp_ns: time; by default one second after the last step.

        Raises InputError: time runs backwards, a type or a shape does not fit, a number is not finite, a name is not a whole
        number from 0 up, or no particle explains the observations.
        """
        if stamp_ns is not None:
            stamp_ns = self.checked_stamp(stamp_ns, self.filter.stamp_ns)
        d, e, p = self.space.dim, self.space.size, self.model.dim
        shapes = {"z": numbers("K", p), "cov_z": numbers("K", p, p)}
        z, cov_z = taken("the step", {"z": z, "cov_z": cov_z}, shapes).values()
        named = {"landmarks": np.full(len(z), NULL) if landmarks is None else landmarks}
        least = 0 if self.hypotheses is None else NULL
        (names,) = taken("the step", named, {"landmarks": integers(len(z), least=least)}).values()
        if odometry is not None:
            if not isinstance(odometry, Odometry):
                raise InputError(f"odometry must be an Odometry with delta and cov, got a {type(odometry).__name__}")
            motion = taken("the odometry", vars(odometry), {"delta": numbers(e), "cov": numbers(d, d)})
            odometry = replace(odometry, **motion)
        self.sensor.model, odometry = self.calibration.tuned(self.filter), self.calibration.driven(odometry)
        if self.hypotheses is None:
            report = self.filter.step(FeatureFrame(stamp_ns or 0, names, z, cov_z), odometry, stamp_ns)
            # A second observation in the frame that starts its landmark is not used.
            again = np.ones(names.size, dtype=bool)
            again[np.unique(names, return_index=True)[1]] = False
            held = [np.ravel(group.ids) for group in report.groups if group.ids is not None]
            used = np.where(again & ~np.isin(names, np.concatenate([names[:0], *held])), NULL, names)
        else:
            used, report = self.hypotheses.step(z, cov_z, odometry, stamp_ns)
            self.filter = self.hypotheses.held[0].filter
        correction, messages = motion_correction(report.mixture), tuple[str, ...]()
        if odometry is not None:
            self._odometry = self.space.compose(self._odometry, odometry.delta)
            if self.calibration.watch(self.filter, odometry, report.mixture[0].factor[0], correction):
                messages = (
                    "the odometry errs alike in all steps: what the wheels get wrong is estimated from here on",
                )

        estimate = self.joint.estimate(self.filter.particles) if self.joint else report.estimate
        if self.joint is not None and self.joint.old.maps:
            # A landmark re-initialised by a new sub-map has been measured before, which its density does not include.
            report = replace(report, log_evidence=np.nan)
        return Tracked(
            report.stamp_ns,
            estimate.mean,
            estimate.cov,
            TrackingState.TRACKED if (used != NULL).any() else TrackingState.PREDICTED,
            {
                **filter_values(report),
                **({} if self.hypotheses is None else {"hypotheses": len(self.hypotheses.held)}),
                "correction": np.full(d, np.nan) if correction is None else correction.mean,
                "cov_correction": np.full((d, d), np.nan) if correction is None else correction.cov,
                "odometry": self._odometry,
                "delta": np.full(e, np.nan) if odometry is None else odometry.delta,
                "cov_delta": np.full((d, d), np.nan) if odometry is None else odometry.cov,
            },
            {"landmarks": used, "z": z, "cov_z": cov_z},
            messages,
        )

    def take(self, frame: Frame) -> Tracked:
        delta, cov = frame.delta, frame.cov_delta
        odometry = None if delta is None or cov is None else Odometry(delta, cov)
        return self.track(frame.z, frame.cov_z, frame.landmarks, odometry, frame.stamp_ns)

    def map(self) -> MapEstimate:
        found = estimate_map(self.filter)
        if self.hypotheses is None:
            return found
        # Landmarks that exist with probability above one half.
        held = np.array([self.hypotheses.held[0].log_odds[name] > 0.0 for name in found.ids.tolist()], dtype=bool)
        return MapEstimate(found.ids[held], found.mean[held], found.cov[held])

    def measurements(self, name: str, log: FrameLog) -> Measurements:
        """The odometry, and all observations that updated or initialised a landmark."""
        frames = [log.observed(t) for t in range(len(log))]
        landmarks = self._final(log)
        used = [np.flatnonzero(ids >= 0) for ids in landmarks]
        p = self.model.dim

        def gathered(key: str, shape: tuple[int, ...]) -> np.ndarray:
            parts = [frame[key][rows] for frame, rows in zip(frames, used, strict=True)]
            return np.concatenate([np.zeros((0, *shape)), *parts])

        return Measurements(
            recording=name,
            space=self.space,
            measurement=self.measurement,
            pitch_sign=self.pitch_sign,
            robot_from_sensor=self.calibration.sensor_pose(self.filter)[0],
            start=self.space.identity(),
            stamps_ns=log.stamps_ns,
            deltas=self.calibration.corrected(self.filter, log["delta"][1:]),
            covs=log["cov_delta"][1:],
            steps=np.repeat(np.arange(len(used)), [rows.size for rows in used]),
            landmarks=np.concatenate([np.zeros(0, dtype=np.int64), *(ids[ids >= 0] for ids in landmarks)]),
            z=gathered("z", (p,)),
            cov_z=gathered("cov_z", (p, p)),
        )

    def summary(self, log: FrameLog) -> dict[str, Any]:
        """Counts of observations and landmarks, and the loss of particle diversity if paths are sampled."""
        distinct = {"ancestors_of_first_generation": self.filter.history.distinct_first()}
        return {
            "landmarks": int(self.map().ids.size),
            "observations": int(sum((ids >= 0).sum() for ids in self._final(log))),
            "map": self.kept_map,
            **self.calibration.entries(self.filter),
            **({} if self.joint else distinct),
            "map_share_of_dense": round(self.filter.belief().map.stored_fraction, 4),
        }

    def _final(self, log: FrameLog) -> list[np.ndarray]:
        """The landmark of every observation, one array (K,) per step, by the heaviest hypothesis, if stored."""
        found = [log.observed(t)["landmarks"] for t in range(len(log))]
        if self.hypotheses is None or not self.hypotheses.keep:
            return found
        known = self.hypotheses.held[0].chosen
        if [ids.size for ids in known] != [ids.size for ids in found]:
            raise InputError(
                "the associations are not of as many observations as its frames have: the checkpoint is damaged"
            )
        return known

    def arrays(self) -> dict[str, np.ndarray]:
        once = np.array(sorted(self.sensor.observed_once), dtype=np.int64)
        kept = {"odometry": self._odometry, "observed_once": once} | self.calibration.arrays()
        return kept if self.hypotheses is None else kept | self.hypotheses.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.sensor.observed_once = set(read_one(arrays, "observed_once", integers("once")).tolist())
        self._odometry = read_one(arrays, "odometry", elements(self.space))
        self.calibration.restore(arrays, dim=self.space.dim, learnt=self.calibration.learnt.size)
        if self.hypotheses is not None:
            self.hypotheses.restore(arrays)
