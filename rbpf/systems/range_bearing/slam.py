"""Range-bearing SLAM in the plane and in space: odometry, a mounted sensor, point landmarks, FastSLAM 2.0.

`RangeBearingSlam(RangeBearingConfig(particles=100))` takes a log entry by `track(z, cov_z, names, odometry, stamp_ns)`.
"""

from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import elements, integers, read_one
from rbpf.core.diagnostics import motion_correction
from rbpf.core.models import NULL, Part
from rbpf.errors import InputError
from rbpf.lie import SE2, SE2Group, SE3Group
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.odometry import Odometry, OdometryMotion, wheel_errors
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing, RelativePosition, RigidPointModel
from rbpf.sensors.readers import Frame, RobotLog
from rbpf.sensors.readers.measurements import Kind, Measurements
from rbpf.systems.map_estimate import MapEstimate, estimate_map
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
        keep_associations: remember which landmark every hypothesis took each observation for, until the end of the run
            tells which one survives; the memory that this takes grows with the run.
        misread: whether a reading may be of another landmark than is said.
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
        self.model: RigidPointModel
        if measurement == "position":
            self.model = RelativePosition(space, self.robot_from_sensor, max_range)
        else:
            view = np.deg2rad(unknown.half_field_of_view_deg)
            self.model = RangeBearing(space, self.robot_from_sensor, pitch_sign, max_range, view)
        self.point = Point(2 if isinstance(space, SE2Group) else 3)
        self.kept_map, self.why_map = config.kept_map()
        is_joint, is_unnamed = self.kept_map == "joint", config.association == "ml"
        if is_unnamed and not is_joint:
            raise InputError(
                "association=ml needs a joint map: leave out map=particles and lag; in a program, a filter with an "
                "AnonymousLandmarkSensor associates in every particle"
            )
        landmark_map: JointMap | LandmarkMap
        # What is estimated: the sensor's place, which moves by free (d, m) s, and what the wheels get wrong.
        std = config.uncertain(space)
        self._learnt = np.flatnonzero(std)
        self._free = np.eye(space.dim, std.size)[:, self._learnt]
        if config.calibrate != "off" and (is_unnamed or not is_joint):
            raise InputError(
                f"calibrate={config.calibrate} takes a joint map of landmarks with names: leave out map=particles, lag and "
                "association=ml"
            )
        if config.calibrate != "off" and not self._learnt.size:
            raise InputError(
                f"calibrate={config.calibrate} leaves nothing to estimate: ask for calibrate=sensor in space, and for a "
                "self_calibration above 0"
            )
        constants = np.zeros(self._learnt.size), np.diag(std[self._learnt] ** 2)
        if is_joint:
            unnamed = is_unnamed and config.submap is not None
            landmark_map = JointMap(space, constants, config.compiled, config.submap, unnamed=unnamed)
        else:
            landmark_map = LandmarkMap(space, compiled=config.compiled)
            landmark_map.register(self.point)
        self.likelihood = likelihood = config.of_innovations(misread)  #: of an innovation.
        self.sensor = sensor = NamedLandmarkSensor(self.model, self.point, likelihood)
        motion = OdometryMotion(space, constants=self._learnt.size, by_constants=self._by_learnt)
        self.filter = self.new_filter(motion, sensor, [landmark_map], config.proposal.build(), config.window)
        self.hypotheses: Hypotheses | None = None
        if is_unnamed:
            self.hypotheses = Hypotheses(self.filter, self.model, unknown, keep_associations)
        self._odometry = space.identity()
        d, e, p = space.dim, space.size, self.model.dim
        self.columns = (
            *FILTER_COLUMNS,
            *([] if self.hypotheses is None else [HYPOTHESES]),
            Column("correction", "what the observations say about the motion, in its whitened coordinates", shape=(d,)),
            Column("cov_correction", "what a consistent filter expects of the correction", shape=(d, d)),
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
        mount, sign = log.robot_from_sensor, log.pitch_sign
        return cls(config, log.space, kind, mount, sign, keep_associations, log.misread)

    def track(
        self,
        z: np.ndarray,
        cov_z: np.ndarray,
        landmarks: np.ndarray | None = None,
        odometry: Odometry | None = None,
        stamp_ns: int | None = None,
    ) -> Tracked:
        """One step: the motion since the last one, and what was then observed.

        Args:
            z: (K, p) measurements.
            cov_z: (K, p, p) their covariance.
            landmarks: (K,) names; None, or −1, where they are not known.
            odometry: motion since the last step; None in the first one.
            stamp_ns: time; by default one second after the last step.

        Raises InputError: time runs backwards, a shape does not fit, or no particle explains the observations.
        """
        names = np.full(len(z), NULL) if landmarks is None else np.asarray(landmarks, dtype=np.int64)
        if self.joint is not None and (own := self.joint.driving()) is not None:
            self._prepare(self.joint, own, np.unique(names[names != NULL]))
        if self.hypotheses is None:
            report = self.filter.step(FeatureFrame(stamp_ns or 0, names, z, cov_z), odometry, stamp_ns)
            # One that comes a second time in the frame that starts its landmark is not used.
            again = np.ones(names.size, dtype=bool)
            again[np.unique(names, return_index=True)[1]] = False
            held = [np.ravel(group.ids) for group in report.groups if group.ids is not None]
            used = np.where(again & ~np.isin(names, np.concatenate([names[:0], *held])), NULL, names)
        else:
            used, report = self.hypotheses.step(z, cov_z, odometry, stamp_ns)
            self.filter = self.hypotheses.held[0].filter
        if odometry is not None:
            self._odometry = self.space.compose(self._odometry, odometry.delta)

        estimate = self.joint.estimate(self.filter.particles) if self.joint else report.estimate
        if self.joint is not None and self.joint.old.maps:
            # A landmark that a further sub-map begins anew has been measured before, which its density does not know.
            report = replace(report, log_evidence=np.nan)
        d, e = self.space.dim, self.space.size
        correction = motion_correction(report.mixture)
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
        )

    def _prepare(self, joint: JointMap, own: np.ndarray, seen: np.ndarray) -> None:
        """Before landmarks (K,) are seen: the sensor is taken to be where the particles (N, m) have it on average.

        A sub-map that is full lets go of the farthest landmarks, and what was put away is held again.
        """
        if self._free.any():
            self.sensor.model = self.model.tuned(self.filter.particles.weights @ own, self._free)
        if joint.is_full:
            others = np.setdiff1d(np.setdiff1d(joint.ids, joint.leaving), seen)
            away = np.linalg.norm(joint.mean[0, joint.held.of_one_kind(others).columns], axis=1)
            joint.make_room(others[np.argsort(-away, kind="stable")])
        if joint.old.maps and joint.bring_back(seen):
            self.filter.consolidate()

    def _by_learnt(self, delta: np.ndarray) -> np.ndarray:
        """How odometry (E,) moves with what is estimated, (d, m) in the right chart at its end."""
        d = self.space.dim
        by_wheels = wheel_errors(delta) if isinstance(self.space, SE2Group) else np.zeros((d, 3))
        return np.concatenate([np.zeros((d, d)), by_wheels], axis=1)[:, self._learnt]

    def wheels(self) -> tuple[np.ndarray, np.ndarray]:
        """What the wheels get wrong as far as it is found (3,), as in `wheel_errors`, and its standard deviations (3,)."""
        found, std, d = np.zeros(3), np.zeros(3), self.space.dim
        own = self._learnt >= d
        if self.joint is not None and own.any():
            mean, cov = self.joint.moments(self.filter.particles, Part.SUBSTATE)
            found[self._learnt[own] - d], std[self._learnt[own] - d] = mean[own], np.sqrt(np.diagonal(cov))[own]
        return found, std

    def sensor_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Robot_from_sensor (E,) as it is given or found, and its covariance (d, d) in the right chart."""
        d, joint = self.space.dim, self.joint
        if joint is None or joint.driving() is None:
            return self.robot_from_sensor, np.zeros((d, d))
        mean, cov = joint.moments(self.filter.particles, Part.SUBSTATE)
        slope = self.space.right_jacobian(self._free @ mean) @ self._free
        return self.model.tuned(mean, self._free).robot_from_sensor, slope @ cov @ slope.T

    def take(self, frame: Frame) -> Tracked:
        odometry = None
        if frame.delta is not None and frame.cov_delta is not None:
            odometry = Odometry(frame.delta, frame.cov_delta)
        return self.track(frame.z, frame.cov_z, frame.landmarks, odometry, frame.stamp_ns)

    def map(self) -> MapEstimate:
        found = estimate_map(self.filter)
        if self.hypotheses is None:
            return found
        held = self.hypotheses.held[0].exist(found.ids)
        return MapEstimate(found.ids[held], found.mean[held], found.cov[held])

    def measurements(self, name: str, log: FrameLog) -> Measurements:
        """The odometry, and every observation that updated a landmark or started one."""
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
            robot_from_sensor=self.sensor_pose()[0],
            start=self.space.identity(),
            stamps_ns=log.stamps_ns,
            deltas=self._corrected(log["delta"][1:]),
            covs=log["cov_delta"][1:],
            steps=np.repeat(np.arange(len(used)), [rows.size for rows in used]),
            landmarks=np.concatenate([np.zeros(0, dtype=np.int64), *(ids[ids >= 0] for ids in landmarks)]),
            z=gathered("z", (p,)),
            cov_z=gathered("cov_z", (p, p)),
        )

    def _corrected(self, deltas: np.ndarray) -> np.ndarray:
        """Odometry (T, E) without what is found to be wrong with it."""
        wrong = self.wheels()[0]
        return self.space.compose(deltas, self.space.exp(wheel_errors(deltas) @ wrong)) if wrong.any() else deltas

    def summary(self, log: FrameLog) -> dict[str, Any]:
        """How much was observed and kept, and how far the particles have forgotten the past, if they sample it."""
        distinct = {"ancestors_of_first_generation": self.filter.history.distinct_first()}
        return {
            "landmarks": int(self.map().ids.size),
            "observations": int(sum((ids >= 0).sum() for ids in self._final(log))),
            "map": self.kept_map,
            **self._calibration(),
            **({} if self.joint else distinct),
            "map_share_of_dense": round(self.filter.belief().map.stored_fraction, 4),
        }

    def _calibration(self) -> dict[str, Any]:
        """Entry of `summary`, of a robot that calibrates itself: what was found, with standard deviations."""
        config = self.config
        if config.calibrate == "off":
            return {}
        (mean, cov), space, dim = self.sensor_pose(), self.space, self.point.dim
        turn, entries = space.rotation(mean), dict[str, tuple[float, float]]()
        if config.calibrate != "odometry":
            within = np.sqrt(np.diagonal(turn @ cov[-dim:, -dim:] @ turn.T))
            entries |= dict(zip(["x_m", "y_m", "z_m"], zip(space.translation(mean), within, strict=True), strict=False))
            if config.self_calibration.yaw_deg:
                entries["yaw_deg"] = (
                    np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0])),
                    np.rad2deg(np.sqrt(cov[-dim - 1, -dim - 1])),
                )
        if (self._learnt >= space.dim).any():
            (drift, left, right), (std_drift, std_left, std_right) = self.wheels()
            entries["heading_deg_per_m"] = np.rad2deg(drift), np.rad2deg(std_drift)
            entries |= {"turn_left": (left, std_left), "turn_right": (right, std_right)}
        stds = {f"std_{name}": float(std) for name, (_, std) in entries.items()}
        return {"calibration": {name: float(value) for name, (value, _) in entries.items()} | stds}

    def _final(self, log: FrameLog) -> list[np.ndarray]:
        """The landmark of every observation, one array (K,) per step, as known now: by the heaviest hypothesis, if kept."""
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
        kept = {
            "odometry": self._odometry,
            "observed_once": np.array(sorted(self.sensor.observed_once), dtype=np.int64),
        }
        if self._learnt.size:
            kept["learnt"] = self._learnt
        return kept if self.hypotheses is None else kept | self.hypotheses.arrays()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.sensor.observed_once = set(read_one(arrays, "observed_once", integers("once")).tolist())
        self._odometry = read_one(arrays, "odometry", elements(self.space))
        if self._learnt.size and not np.array_equal(read_one(arrays, "learnt", integers("learnt")), self._learnt):
            raise InputError(f"the checkpoint is of another robot than one with calibrate={self.config.calibrate}")
        if self.hypotheses is not None:
            self.hypotheses.restore(arrays)
