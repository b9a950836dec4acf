"""Stereo SLAM (S05): visual odometry moves the particles, landmarks of a shared map weigh them.

    slam = StereoSlam(rig)
    for stamp_ns, left, right in source:
        frame = slam.track(left, right, stamp_ns)     # pose, covariance, state of tracking, what was observed

`StereoSlam.take` processes a pair step by step.
"""

import time
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, final

import numpy as np

from rbpf.core.checkpoint import integers, numbers, poses, read, truths
from rbpf.core.models import NULL, Landmark, Part, Proposal
from rbpf.core.particles import Estimate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.joint_map import JointMap
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.motion.odometry import CAMERA_PLANE, Odometry, OdometryMotion
from rbpf.motion.stereo_geometry import Matches
from rbpf.motion.stereo_vo import candidate_motions, pixel_gains, product, refine_motion
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.camera.points import CameraModel
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog
from rbpf.sensors.features import FeatureExtractor, Sift
from rbpf.sensors.readers import ImageFrame
from rbpf.sensors.stereo import REMEMBERED, calibration_doubt
from rbpf.systems.filtering import ProposalConfig
from rbpf.systems.map_estimate import MapEstimate, estimate_map
from rbpf.systems.stereo.calibration import SelfCalibration
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.dead_reckoning import DeadReckoning
from rbpf.systems.stereo.front_end import FrontEnd, ImageFrontEnd
from rbpf.systems.stereo.landmarks import AssociationGate, DescriptorLandmarks, Pair
from rbpf.systems.stereo.motion_segmentation import MOVING, STATIC, UNKNOWN, camera_motion, contradicts
from rbpf.systems.stereo.tracks import tracked_features
from rbpf.systems.system import (
    DIAGNOSTICS,
    ESS,
    LOG_EVIDENCE,
    NIS,
    NIS_DOF,
    RESAMPLED,
    Column,
    FrameLog,
    Ragged,
    System,
    Tracked,
    TrackingState,
    filter_values,
    timing,
)

_STEREO = {
    "frames": integers(3, least=0),
    "at_update": poses(),
    "cov_at_update": numbers(6, 6),
    "since_update": poses(),
    "impossible": numbers(2),
    "doubted": truths(),
}


@final
class StereoSlam(System):
    """SLAM with a rectified stereo camera; its first pair is the world's origin.

    Its memory grows only with the map; of the particles' paths it keeps `lag` updates.

    Args:
        rig: the two cameras.
        config: all settings.
        extractor: detects and describes keypoints; None for SIFT.
        gate: gates features and landmarks; None for that of `config`.
        model: observation model of landmarks; None for pixels of points in space.
        landmark: its parametrisation; None for points in space.
        front_end: measures frames and associates landmarks; None for images, `NamedFrontEnd` for pixels of named landmarks.
    """

    name: ClassVar[str] = "stereo"
    frame_word: ClassVar[str] = "pair"
    columns = (
        Column("features", "features that both cameras see", kind=int, table=DIAGNOSTICS),
        Column("agreeing", "matches that agree with the motion since the last pair", kind=int, table=DIAGNOSTICS),
        Column("assumed", "consecutive pairs whose motion was only assumed", kind=int, table=DIAGNOSTICS),
        Column("updated", "whether the filter was updated", kind=bool, table=DIAGNOSTICS),
        Column("observed", "landmarks that weighed the particles", kind=int, table=DIAGNOSTICS),
        RESAMPLED,
        NIS_DOF,
        ESS,
        LOG_EVIDENCE,
        NIS,
        timing("seconds_features", "time of measuring the pair", "features_ms"),
        timing("seconds_odometry", "time of estimating the motion", "odometry_ms"),
        timing("seconds_matching", "time of associating landmarks", "matching_ms"),
        timing("seconds_filter", "time of the rest of the update", "filter_ms"),
        Column("odometry", "world_from_camera by visual odometry alone", shape=(7,)),
        Column("measured", "whether the next pair is matched with this one", kind=bool),
        Column("offset_px", "disparity offset used, by which disparities are too small"),
    )
    observed = (
        Ragged("z", "pixels (u_left, v, u_right) of the features", (3,)),
        Ragged("cov_z", "their covariance, px²", (3, 3), per="z"),
        Ragged("kind", "role of each in the map, see `FeatureKind`", kind="int8", per="z"),
        Ragged("landmarks", "landmark of each, −1 for none", kind="int64", per="z"),
        Ragged("previous", "row of the match in the last measured pair, −1 for none", kind="int64", per="z"),
    )
    space = SE3
    config: StereoConfig

    def __init__(
        self,
        rig: RectifiedStereo,
        config: StereoConfig | None = None,
        extractor: FeatureExtractor | None = None,
        gate: AssociationGate | None = None,
        model: CameraModel | None = None,
        landmark: Landmark | None = None,
        front_end: FrontEnd[Any] | None = None,
    ) -> None:
        self.rig, self.config = rig, config or StereoConfig()
        config = self.config
        if front_end is None:
            extractor = extractor or Sift(config.sift)
            landmarks = DescriptorLandmarks(rig, config, extractor.length, gate, model, landmark)
            front_end = ImageFrontEnd(rig, config, extractor, landmarks)
        self.front_end = front_end
        free = CAMERA_PLANE if config.dof == 3 else None
        added = np.repeat([config.odometry.std_added_rad, config.odometry.std_added_m], 3)
        self._constrained = OdometryMotion(SE3, free=free).constrained
        self._free = np.diag(np.ones(6) if free is None else np.array(free, dtype=float))
        joint, self._calibration = None, SelfCalibration(config, front_end)
        if config.map.kind == "joint":
            if not config.likelihood.build().normalised:
                raise InputError(
                    f"map.kind=joint needs a likelihood that is a density, and likelihood.kind={config.likelihood.kind} is "
                    "none: set likelihood.kind=student, or map.kind=particles"
                )
            options: dict[str, Any] = {"passed_on": True, "constants": int(self._calibration.is_held)}
            joint = JointMap(SE3, self._calibration.prior, config.compiled, config.map.submap, **options)
        self._once = joint is not None or config.odometry.role == "proposal"
        self._proposal = ProposalConfig("ekf", 1) if joint else config.proposal
        refined = joint is not None or (config.proposal.kind == "ekf" and config.map.weigh == "all")
        if self._once and not refined:
            raise InputError(
                "odometry.role=proposal needs proposal.kind=ekf and map.weigh=all: the motion is then known by the landmarks "
                "alone, candidates among them"
            )
        own = LandmarkMap(SE3, compiled=config.compiled)
        own.register(front_end.landmarks.landmark)
        odometry = OdometryMotion(SE3, added, free, constants=int(self._calibration.is_held))
        parts = [joint or own]
        self.filter = self.new_filter(odometry, front_end.landmarks, parts, self._proposal.build(), config.map.window)
        self.frames = 0  #: pairs taken so far.
        self.reckoning = DeadReckoning()  #: composed visual odometry.
        self.at_update = Estimate(SE3.identity(), np.zeros((6, 6)))  #: the filter's estimate at its last update.
        #: motion from the filter's last update to the last pair, including assumed motions.
        self.since_update = SE3.identity()
        self._last_update, self._last_ns = 0, 0  # of `frames`, and time of the last one
        self._kept: Pair[Any] | None = None
        # Decaying counts of negative-disparity matches and of all; whether the warning was given.
        self._impossible, self._doubted = np.zeros(2), False

    def track(self, left: np.ndarray | None, right: np.ndarray | None, stamp_ns: int) -> Tracked:
        """A pair of rectified images (H, W) uint8, taken at one time.

        A pair with too few features, with a missing image, that cannot be from these cameras, or with the last one's time, is
        passed over: its pose is predicted, and `messages` give the reason. Images of another size in the first pair raise an
        error. A missing image is None.

        Raises InputError: left and right are swapped, time runs backwards, no particle explains the pair, or the first images
        are not the cameras'.
        """
        return self.take(ImageFrame(stamp_ns, left, right))

    def take(self, frame: Any) -> Tracked:
        """`track` with a frame of a recording, an `ImageFrame`, or another one that the front end takes."""
        started, front_end = time.perf_counter(), self.front_end
        if not isinstance(frame, front_end.takes):
            raise InputError(f"stereo SLAM is given a {type(frame).__name__}, and takes {front_end.takes.__name__}")
        frame = replace(frame, stamp_ns=self.checked_stamp(frame.stamp_ns))
        # The first frame must fit the cameras.
        if not self.frames and (refusal := front_end.refusal(frame)):
            raise InputError(refusal)
        offset_px = self._calibration.tune(self.filter)

        # 1. Measure the pair: features in both images.
        pair, problem = front_end.measure(frame)
        stamp_ns, messages, config, landmarks = frame.stamp_ns, list[str](), self.config, front_end.landmarks
        seconds_features = time.perf_counter() - started

        # 2. Estimate the motion since the last measured pair; with too few features predict it.
        dt, least = self.reckoning.seconds(pair.stamp_ns), config.odometry.estimate.min_matches
        last_ns = self.checked_stamp(pair.stamp_ns, self._last_ns)
        measured = len(pair) >= least and dt > 0.0
        if measured:
            pair, motion = self._motion_to(pair, dt)
            self._impossible = REMEMBERED * self._impossible + front_end.impossible()
            doubt = "" if self._doubted else calibration_doubt(*self._impossible)
            self._doubted |= bool(doubt)
            messages += filter(None, (problem, doubt, motion.message))
        else:
            few = f"it shows {len(pair)} features, {least} are needed" if dt > 0 else "it has the stamp of the last one"
            why = f"{few}; {problem}" if problem and (len(pair) or pair.images) else problem or few
            expected = last = self.reckoning
            then = "the world begins with the first pair that is measured"
            if last.stamp_ns is not None:  # the next pair has the same reference pair
                then = "the last velocity is assumed, widely"
                self.reckoning = replace(last, passed_over=last.passed_over + 1)
                step = self._constrained(config.odometry.prior.increment(last.velocity, dt))
                expected = last.moved(last.stamp_ns, step, last.velocity, is_assumed=True)
            messages.append(f"passed over: {why}; {then}")
            motion = _Motion(expected)
        at = motion.at
        seconds_odometry = time.perf_counter() - started - seconds_features

        # 3. Update the filter if the camera has moved enough. After an assumed motion only once the camera is relocalised in
        # the map: until then no particle moves.
        report, seconds_filter = None, 0.0
        due = self.filter.steps == 0 or config.trigger.reached(at.since_update, self.frames - self._last_update)
        if measured:
            self.reckoning = at
        if measured and due:
            uncertain = config.recovery.used and at.assumed > 0
            control: Odometry | None = at.since_update
            for_map = pair.for_map.copy()
            for_map[motion.rows[1][motion.moving]] = False
            view = replace(pair, for_map=for_map, uncertain=uncertain)
            if uncertain:
                control, message = self._recovered_motion(view, at)
                messages += filter(None, (message,))
            if control is not None:
                begun = time.perf_counter()
                proposal = config.recovery.proposal.build() if uncertain else None
                if self._once and self.filter.steps and not uncertain:
                    view, control, proposal = self._proposed(view, control, at.left_over, offset_px)
                report = self.filter.step(view, control if self.filter.steps else None, pair.stamp_ns, proposal)
                self.reckoning, self._last_update = at.updated(), self.frames
                messages += filter(None, (self._calibration.watch(self.filter),))
                found = self.joint.estimate(self.filter.particles) if self.joint else report.estimate
                self.at_update = Estimate(found.mean, found.cov)
                seconds_filter = time.perf_counter() - begun - landmarks.seconds
        updated = report is not None

        # 4. Store the pair with its labels, as the reference of the next one.
        if measured:
            static = landmarks.confirmed_static() if updated else np.zeros(0, dtype=np.intp)
            features = self._calibration.retuned(self.filter, pair.features, offset_px) if updated else pair.features
            if updated and view.starts is not None:
                left_over = np.concatenate([features.z[..., None], features.cov], axis=2)
                left_over[landmarks.ids != NULL] = 0.0
                self.reckoning = replace(self.reckoning, left_over=left_over)
            self._kept = replace(pair, features=features, images=None, labels=motion.labelled(len(pair), static))
        self.frames, self._last_ns = self.frames + 1, last_ns

        # 5. Report: between updates the pose is extrapolated by the odometry.
        pose, cov = self.at_update.mean, self.at_update.cov
        self.since_update = SE3.identity() if updated else at.since_update.delta
        if not updated:
            moved = Odometry(pose, cov).then(at.since_update)
            pose, cov = moved.delta, moved.cov
        assumed = self.frames if at.stamp_ns is None else 0 if updated and config.recovery.used else at.assumed
        state = TrackingState.PREDICTED
        if measured and not (updated and assumed):
            state = TrackingState.LOST if assumed else TrackingState.TRACKED
        figures: dict[str, Any] = {column.name: column.kind(0) for column in self.columns if not column.shape}
        if report is not None:
            weighed = [group.ids for group in report.groups if Part.STATE in group.updates and group.ids is not None]
            figures |= filter_values(report) | {"observed": sum(int((ids >= 0).sum()) for ids in weighed)}
        ids, kinds = front_end.landmarks_of(pair, updated)
        told = landmarks.told(pair) if updated else pair.features
        previous = np.full(len(pair), NULL, dtype=np.int64)
        previous[motion.rows[1][motion.inliers]] = motion.rows[0][motion.inliers]
        return Tracked(
            stamp_ns,
            pose,
            cov,
            state,
            {
                **figures,
                "features": len(pair),
                "agreeing": int(motion.inliers.sum()),
                "assumed": assumed,
                "updated": updated,
                "seconds_features": seconds_features,
                "seconds_odometry": seconds_odometry,
                "seconds_matching": landmarks.seconds if updated else 0.0,
                "seconds_filter": seconds_filter,
                "odometry": at.world_from_camera,
                "measured": measured,
                "offset_px": offset_px,
            },
            {"z": told.z, "cov_z": told.cov, "kind": kinds, "landmarks": ids, "previous": previous},
            tuple(messages),
            self._calibration.told(self.filter, stamp_ns, pose, cov, self.since_update),
        )

    def map(self) -> MapEstimate:
        """The landmarks, and the candidates; with further columns, see `Landmarks.columns`."""
        found = estimate_map(self.filter)
        return replace(found, columns=self.front_end.landmarks.columns(found.ids))

    def particle_poses(self) -> np.ndarray:
        """(N, 7) world_from_camera of the particles at the last pair, extrapolated by odometry between updates."""
        return SE3.compose(super().particle_poses(), self.since_update)

    def measurements(self, name: str, log: FrameLog) -> FeatureLog:
        """All pixels used by odometry or map, each once, as tracks; for named pixels all."""
        shown, offset_px = [log.observed(t) for t in range(len(log))], self.calibration()[0]
        for pair, then_px in zip(shown, log["offset_px"].tolist(), strict=True):
            # Corrected by the final self-calibration.
            pair["z"] = pair["z"] + [0.0, 0.0, then_px - offset_px]
        if self.front_end.names_landmarks:
            parts = [(pair["landmarks"], pair["z"], pair["cov_z"]) for pair in shown]
            stamped = zip(log.stamps_ns.tolist(), parts, strict=True)
            frames = [FeatureFrame(stamp_ns, *part) for stamp_ns, part in stamped]
        else:
            frames = tracked_features(log.stamps_ns, log["measured"], shown)
        return FeatureLog(name, self.rig, frames)

    def calibration(self) -> tuple[float, float]:
        """Common disparity offset (all are too small by it), px, and its standard deviation; 0 if not estimated."""
        return self._calibration.estimate(self.filter)

    def summary(self, log: FrameLog) -> dict[str, Any]:
        """Counts over the pairs, and the filter's statistics over its updates."""
        updated = log["updated"].astype(bool)
        evidence = log["log_evidence"][updated]
        milliseconds = 1e3 * (log["seconds_matching"] + log["seconds_filter"])[updated] if updated.any() else 0.0
        steps = np.diff(SE3.translation(log.poses), axis=0)
        return {
            "frames_measured": int((log["features"] >= self.config.odometry.estimate.min_matches).sum()),
            "updates": int(updated.sum()),
            "distance_m": float(np.linalg.norm(steps, axis=1).sum()),
            "dof": self.config.dof,
            "map": self.config.map.kind if self.config.map.used else "none",
            **self._calibration.entries(self.filter),
            "ms_per_update": {
                "median": round(float(np.median(milliseconds)), 3),
                "p95": round(float(np.percentile(milliseconds, 95)), 3),
            },
            **self.front_end.landmarks.counts(self.filter.belief().map.ids.size),
            "features_per_frame": float(log["features"].mean()),
            "observations_per_update": float(log["observed"][updated].mean()) if updated.any() else 0.0,
            "ess_mean": float(log["ess"][updated].mean()) if updated.any() else 0.0,
            "log_evidence": float(evidence.sum()) if np.isfinite(evidence).all() else None,
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The last measured pair, the landmarks' descriptors or names, and the odometry."""
        frames, doubted = np.array([self.frames, self._last_update, self._last_ns]), np.array(self._doubted)
        own = frames, self.at_update.mean, self.at_update.cov, self.since_update, self._impossible, doubted
        return {
            **({} if self._kept is None else self.front_end.arrays(self._kept)),
            **self._calibration.arrays(),
            **self.front_end.landmarks.arrays(),
            **self.reckoning.arrays(),
            **{f"stereo/{name}": array for name, array in zip(_STEREO, own, strict=True)},
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        found = read(arrays, _STEREO, "stereo/")
        self.frames, self._last_update, self._last_ns = found["frames"].tolist()
        self.at_update = Estimate(found["at_update"], found["cov_at_update"])
        self.since_update = found["since_update"]
        self._impossible, self._doubted = found["impossible"], bool(found["doubted"])
        self.reckoning = DeadReckoning.restored(arrays)
        self.front_end.landmarks.restore(arrays)
        self._kept = self.front_end.pair_of(arrays) if "pair/z" in arrays else None
        self._calibration.restore(arrays)

    def _motion_to(self, pair: Pair[Any], dt: float) -> tuple[Pair[Any], "_Motion"]:
        """The pair, with points matched to the last measured one aligned; and the motion between, in `dt` seconds."""
        before, kept, stamp_ns, config = self.reckoning, self._kept, pair.stamp_ns, self.config.odometry
        if kept is None:
            return pair, _Motion(replace(before, stamp_ns=stamp_ns))
        rows = self.front_end.match(kept, pair)
        pair = self.front_end.aligned(kept, pair, rows)
        matches, labels = self.front_end.matches(kept, pair, rows), kept.labels[rows[0]]
        expected, is_moving = config.prior.increment(before.velocity, dt), bool(before.velocity.any())
        motions, failure = candidate_motions(matches, expected, self.filter.rng, config.estimate)

        # Select the camera's motion among those with support; a single one is accepted unless other evidence contradicts.
        chosen = 0 if motions else -1
        doubted = len(motions) > 1 or (motions and contradicts(motions[0].inliers, labels, before.hidden))
        moving = np.zeros(len(matches), dtype=bool)
        if doubted:
            # The map's support of each candidate, and of the prior alone.
            support = np.zeros(len(motions) + 1)
            if self.filter.steps:
                view = replace(pair, uncertain=before.assumed > 0)
                for number, step in enumerate([*(motion.odometry for motion in motions), expected]):
                    belief = self.filter.expect(before.since_update.then(self._constrained(step)), stamp_ns)
                    support[number] = self.front_end.landmarks.log_support(view, belief)
            chosen = camera_motion(motions, expected if is_moving else None, labels, before.hidden, support)
            for number, other in enumerate(motions):
                moving |= other.inliers & (number != chosen)
            many = " and ".join(str(motion.inliers.sum()) for motion in motions)
            failure = f"{many} of {len(matches)} matches agree on a motion, but not the map and what stood still before"

        # If there is none, the prior is assumed.
        if chosen < 0:
            what = "the last velocity" if is_moving else "a camera at rest"
            step = self._constrained(expected)
            at = before.moved(stamp_ns, step, before.velocity, is_assumed=True, hidden=bool(moving.any()))
            nobody = np.zeros(len(matches), dtype=bool)
            return pair, _Motion(at, rows, labels, nobody, moving, f"{failure}; {what} is assumed, widely")
        motion = motions[chosen]
        notes = [motion.note] if motion.note else []
        if moving.any():
            count = motion.inliers.sum()
            notes.append(
                f"{count} of {len(matches)} matches agree on a motion and {moving.sum()} on another: something in the "
                f"view moves, and the camera's motion is taken to be that of the {count}"
            )
        velocity = before.velocity
        if config.prior.keep_velocity:
            velocity = SE3.log(motion.odometry.delta) / dt
        cross, noise = None, None
        if not config.independent:
            # Cross-covariance of this step's and the last one's error, by the shared pixels of the pair between them.
            used = matches.take(motion.inliers)
            earlier, later = pixel_gains(used, motion.odometry, config.estimate)
            if before.noise.size:
                shared = before.noise[rows[0][motion.inliers]]
                cross = self._free @ np.einsum("kap,kbp->ab", shared, earlier) @ self._free
            noise = np.zeros((len(pair), 6, 3))
            noise[rows[1][motion.inliers]] = later @ used.cov_now
        left_over = None
        if before.left_over.size:
            left_over = np.zeros((len(pair), 3, 4))
            left_over[rows[1][motion.inliers]] = before.left_over[rows[0][motion.inliers]]
        step = self._constrained(motion.odometry)
        at = before.moved(stamp_ns, step, velocity, cross=cross, noise=noise, left_over=left_over)
        return pair, _Motion(at, rows, labels, motion.inliers, moving, "; ".join(notes))

    def _recovered_motion(self, view: Pair[Any], at: DeadReckoning) -> tuple[Odometry | None, str]:
        """The motion by which particles are moved after an assumed motion, or None, and a message.

        An assumed motion is a wide Gaussian that grows with every pair, and no particle is drawn from it before the camera is
        relocalised: None. Drawn at once, a few hundred particles would be decimetres apart, none within millimetres of the
        true pose, and so would be new landmarks. A map that is too small for relocalisation is not waited for.

        A relocalised pose far from the assumed mean replaces it, as the odometry was misled. Its covariance is kept, and
        leaves the refinement to each particle's map.
        """
        landmarks, motion, least = self.front_end.landmarks, at.since_update, self.config.map.min_agreeing
        if landmarks.seen_again().size < least:
            return motion, ""
        after = f"after {at.assumed} pair{'s'[: at.assumed > 1]} whose motion was only assumed"
        _, count = self._associated(view, motion)
        if count < least:
            belief = self.filter.expect(motion, view.stamp_ns)
            place = landmarks.relocalised(view, belief, self.config.odometry.estimate)
            if place is not None:
                count, heaviest = place[1], self.filter.particles.state[belief.mode]
                motion = Odometry(SE3.between(heaviest, place[0]), motion.cov)
                self._associated(view, motion)
        if count >= least:
            return motion, f"the camera is found again by {count} landmarks of the map, {after}"
        if at.waiting >= self.config.recovery.patience:
            return motion, f"the camera is not found again in the map, which goes on from here, {after}"
        return None, ""

    def _associated(self, view: Pair[Any], moved: Odometry) -> tuple[Pair[Any], int]:
        """The view with associated landmarks, and their number.

        Landmarks that a joint map has put away are brought back, for which its window ends. Features of those that cannot be
        brought back yet (too few distant ones) are left out.
        """
        landmarks, belief = self.front_end.landmarks, self.filter.expect(moved, view.stamp_ns)
        ids, away = landmarks.associate(view, belief), np.zeros(len(view), dtype=bool)
        if self.joint is not None:
            found = landmarks.put_away(view, belief, self.joint, ids == NULL)
            away = found != NULL
            if self.joint.bring_back(np.append(ids[ids != NULL], found[away])):
                self.filter.consolidate()
                ids = landmarks.associate(view, self.filter.expect(moved, view.stamp_ns))
                away &= ids == NULL
        return replace(view, landmarks=ids, for_map=view.for_map & ~away), int((ids != NULL).sum())

    def _proposed(
        self, view: Pair[Any], moved: Odometry, left_over: np.ndarray, offset_px: float
    ) -> tuple[Pair[Any], Odometry, Proposal | None]:
        """Inputs of the filter if the odometry is its proposal: the view with its landmarks, the prior, the proposal.

        If too few landmarks are in view to determine the motion, the odometry's pixels are not in the map either: then the
        odometry moves the particles.
        """
        assert self.filter.stamp_ns is not None
        view, count = self._associated(view, moved)
        if count < self.config.map.min_agreeing:
            return view, moved, None
        dt = 1e-9 * (view.stamp_ns - self.filter.stamp_ns)
        # Without a measured velocity the prior is centred on the odometry.
        velocity = self.reckoning.velocity_at_update if self.filter.steps > 1 else SE3.log(moved.delta) / dt
        prior = self.config.odometry.prior.increment(velocity, dt)
        if self.joint is not None:
            view, free = self.front_end.landmarks.left_over(view)
            if left_over.size:
                rows = np.flatnonzero(free & left_over.any(axis=(1, 2)))
                prior = self._joined(prior, moved, left_over[rows], view.features.take(rows), offset_px)
        prior = self._constrained(prior)
        return view, prior, self._proposal.build(SE3.local(prior.delta, moved.delta))

    def _joined(
        self, prior: Odometry, moved: Odometry, before: np.ndarray, features: Any, offset_px: float
    ) -> Odometry:
        """The prior, fused with the motion from matches since the last update that a joint map does not use.

        `before` (k, 3, 4) are their pixels as in `DeadReckoning.left_over`. The next update's matches start with the pixels
        at which these end, whose noise has opposite signs in both. Treated as independent, they are underconfident.
        """
        noise, config = self.front_end.landmarks.noise, self.config.odometry.estimate
        factor = 1.0 if noise is None else noise.mean
        covs = factor * before[..., 1:], factor * features.cov
        matches = Matches.checked(self.rig, before[..., 0], features.z, *covs)
        found = refine_motion(matches, moved.delta, config)
        if not found.found:
            return prior
        measured = found.odometry
        if not self._calibration.is_held:
            return product(measured, prior)[0]
        # The pixels are corrected by the disparity offset known when the pair was measured, before old landmarks were brought
        # back, which changes its estimate. The motion depends on the difference.
        earlier, later = pixel_gains(matches.take(found.inliers), measured, config)
        slope = -(earlier + later).sum(axis=0)[:, 2:]
        joined, _ = product(replace(measured, by_constants=slope), prior)
        assert joined.by_constants is not None
        return replace(joined, delta=SE3.retract(joined.delta, -joined.by_constants[:, 0] * offset_px))


_NO_ROWS, _NO_MATCHES = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool)


class _Motion(NamedTuple):
    """The motion up to a pair, and its M matches with the last measured pair."""

    at: DeadReckoning
    rows: tuple[np.ndarray, np.ndarray] = (_NO_ROWS, _NO_ROWS)  # (M,) rows of that pair and of this one
    labels: np.ndarray = np.zeros(0, dtype=np.int8)  # (M,) labels in the last measured pair
    inliers: np.ndarray = _NO_MATCHES  # (M,) inliers of the camera's motion
    moving: np.ndarray = _NO_MATCHES  # (M,) inliers of another one: on moving objects
    message: str = ""  # a warning about assumptions made

    def labelled(self, count: int, mapped: np.ndarray) -> np.ndarray:
        """Labels (K,) of this pair's features, of which rows `mapped` are consistent with the map; see `motion_segmentation`.

        Without inliers of the camera's motion all keep their labels.
        """
        out = np.full(count, UNKNOWN, dtype=np.int8)
        if self.inliers.any():
            out[self.rows[1][self.inliers]] = STATIC
        else:
            out[self.rows[1]] = self.labels
        out[self.rows[1][self.moving]] = MOVING
        out[mapped] = STATIC
        return out
