"""Monocular SLAM (E06): one camera, constant velocity, points and rays, and a particle filter over its pose.

    slam = MonoSlam(camera)
    for stamp_ns, image in source:
        frame = slam.track(image, stamp_ns)

`MonoSlam.take` processes a frame: check of the image, pose prior, the filter's step with active search inside, the report,
and, until depths have converged, the batch adjustment of the first frames.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.filter import Filter, StepReport
from rbpf.core.marginals import KalmanSubstate
from rbpf.core.models import Conditional, MotionModel, Records, Sensor
from rbpf.core.particles import Estimate, mixture_estimate
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.constellation import Constellation
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.motion.constant_velocity import MarginalVelocity, PosePrior, SampledVelocity
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.feature_log import FeatureFrame, FeatureLog, KnownPoints
from rbpf.sensors.features import Descriptor, Detector
from rbpf.sensors.readers import ImageFrame, KnownPixels
from rbpf.sensors.readers.images.calibration import NAME as CAMERA
from rbpf.sensors.readers.images.calibration import camera_text
from rbpf.systems.map_estimate import Anchored, MapEstimate, relative_estimate
from rbpf.systems.mono.active_search import OutlierGate
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_sensor import FeatureSensor, InverseDepthRays, UnknownDepth
from rbpf.systems.mono.feature_table import directions
from rbpf.systems.mono.image_sensor import ImageScreen, ImageSensor, Measurement
from rbpf.systems.mono.joint import NUMBERS, HandOver
from rbpf.systems.mono.known_map import NAME, KnownMap, distant_views, estimate_mono_map, known_map_arrays
from rbpf.systems.mono.place_recognition import PlaceRecognition
from rbpf.systems.mono.relocalisation import Attempt, TrackingLoss
from rbpf.systems.mono.start.adjustment import FirstFrames
from rbpf.systems.mono.start.known import KnownStart, constellation_records, require_texture, world_of
from rbpf.systems.mono.start.unknown import UnknownStart
from rbpf.systems.system import (
    DIAGNOSTICS,
    FILTER_COLUMNS,
    Column,
    FrameLog,
    Gauge,
    Ragged,
    Revision,
    System,
    Tracked,
    TrackingState,
    filter_values,
    timing,
)

LINE_SIGMAS = 3.0  #: Epipolar lines are reported between inverse depths this many standard deviations from the mean.
LOST = "the camera is lost, its pose is held until the map is seen again"
FOUND_AGAIN = "the camera is found again"
FOUND_IN_MAP = "the camera is found in the map"
COME_BACK = "the camera is back where it was, its way and its map are corrected"


@final
class MonoSlam(System):
    """SLAM with one camera.

    It takes images, or named features, but not both. The world is that of the known points or of the known map; without them
    that of the first camera, in a scale in which new features are on average 1 / `inverse_depth.mean_per_m` away. When the
    joint map starts, the first frames are adjusted in batch, and their poses revised. Its memory holds the map, its features'
    appearances, and `lag` frames of the particles' paths.

    Args:
        camera: of the images.
        config: all settings.
        known: points of known position in the first image: with their pixels in it, or, for named features, under their
            names. Without them particles are resampled from adjustments of the first frames.
        known_map: a map in which the camera is localised instead of mapping; it is not changed.
        unknown_depth: storage of features of unknown depth; by default rays with inverse depth.
        gate: selects the matches that agree with one motion of the camera; by default a robust fit.
        detector: detects corners for new features and for relocalisation; by default FAST corners with the Shi-Tomasi score.
        descriptor: descriptor for relocalisation; by default SIFT.
        wrapped: wraps the sensor of named features, to change its observations or new landmarks. Adjustments of the first
            frames, and returns of old landmarks, use the original features; only a joint map starts from one.

    Raises InputError: known points do not determine the camera, or the map is of another camera.
    """

    name: ClassVar[str] = "mono"
    waiting: ClassVar[str | None] = "waiting_for_image_ms"
    columns = (
        Column("searched", "features looked for", kind=int, table=DIAGNOSTICS),
        Column("found", "features that the filter used", kind=int, table=DIAGNOSTICS),
        Column("lost", "whether the camera was lost after the frame", kind=bool, table=DIAGNOSTICS),
        *FILTER_COLUMNS,
        Column("relocalised", "whether a camera that was lost was found again in the frame", kind=bool),
        Column("points", "points in the map after the frame", kind=int),
        Column("rays", "features of unknown depth in the map after the frame", kind=int),
        timing("seconds_search", "time of the search in the image", "search_ms"),
        timing("seconds_filter", "time of everything else", "filter_ms"),
        timing("seconds_new_landmarks", "time of judging what was looked for and starting features", "new_features_ms"),
    )
    observed = (
        Ragged("features", "features that were looked for", kind="int64"),
        Ragged("mean", "their predicted places, px", (2,), per="features"),
        Ragged("cov", "covariance of these, with the noise of the measurement, px²", (2, 2), per="features"),
        Ragged("px", "where each was found, px; NaN where not", (2,), per="features"),
        Ragged("cov_px", "covariance of the noise of px, as it is stated, px²", (2, 2), per="features"),
        Ragged("line", "ends of the epipolar line of one whose depth is unknown, px; else NaN", (2, 2), per="features"),
        Ragged("position", "homogeneous point in the reported world; NaN where it was not found", (4,), per="features"),
        Ragged("started", "features that were started", kind="int64"),
        Ragged("started_px", "where, px", (2,), per="started"),
    )
    space = SE3
    config: MonoConfig

    def __init__(
        self,
        camera: Pinhole,
        config: MonoConfig | None = None,
        known: KnownPixels | KnownPoints | None = None,
        known_map: KnownMap | None = None,
        unknown_depth: UnknownDepth | None = None,
        gate: OutlierGate | None = None,
        detector: Detector | None = None,
        descriptor: Descriptor | None = None,
        wrapped: Callable[[Sensor], Sensor] | None = None,
    ) -> None:
        if not isinstance(camera, Pinhole):
            raise InputError("monocular SLAM needs one camera, this is a stereo pair")
        if known is not None and known_map is not None:
            raise InputError("in a known map a run starts from the map: leave out known points")
        self.camera, self.config = camera, config or MonoConfig()
        self.known, self.known_map = known, known_map
        config = self.config

        # Known points are located by their pixels at once; under names, by the first frame.
        self._start: KnownStart | None = None
        points: KnownPoints | None = known if isinstance(known, KnownPoints) else None
        if isinstance(known, KnownPixels):
            self._start = KnownStart.from_pixels(camera, known, config.search.noise_px)
            points = self._start.points
        if known_map is not None:
            known_map.require_camera(camera)
            points = known_map.points
        #: Known points, by the names of features; or None.
        self.known_points = points
        group = points if config.known == "frame" and known_map is None else None

        rays = unknown_depth or InverseDepthRays(camera, config.inverse_depth)
        is_fixed = known_map is not None
        self.first = FirstFrames()
        self.hand_over = HandOver(config, camera, points, rays, is_fixed, self.first)
        self.features = FeatureSensor(camera, rays, config.max_new_per_frame, group, is_fixed)
        self.sensor = ImageSensor(self.features, config.search, gate, detector, descriptor)
        self._named: Sensor = self.features if wrapped is None else wrapped(self.features)
        self.filter = self._new_filter(self.sensor)
        self.screen = ImageScreen(camera)
        if known_map is not None:
            self._add_points(known_map.points)
            appearances = known_map.windows, known_map.first_px, known_map.first_pose
            self.sensor.begin_lost(*appearances, known_map.positions)
        views = () if known_map is None else (known_map.views, known_map.size_m)
        self.loss = TrackingLoss(self.sensor, config, *views)
        self.place_recognition = PlaceRecognition(self.loss.relocaliser, config)
        is_unknown = points is None and wrapped is None
        self.start = UnknownStart(config, self.features, self.first, self._new_filter, is_unknown)
        self.gauge: Gauge = "none"
        if known_map is not None:
            self.gauge = known_map.alignment
        elif known is None:
            self.gauge = "similarity"
        elif isinstance(known, KnownPixels) and known.own_frame:
            self.gauge = "rigid"
        #: The sensor's results for the last image; None before the first one, and for named features.
        self.measurement: Measurement | None = None
        #: The relocalisation attempt in the last frame; None if the camera was not lost.
        self.attempt: Attempt | None = None
        self.report: StepReport | None = None  #: The filter's report of the last frame.

    def track(self, image: np.ndarray | None, stamp_ns: int) -> Tracked:
        """Takes an image (H, W) uint8, grey, of the camera's size; None for a missing image.

        Images without texture, or of another kind, are passed over: the pose is then predicted, and the message gives the
        reason.

        Raises InputError: time runs backwards; the first image does not show the known points; or no particle explains the
        matches.
        """
        return self.take(ImageFrame(stamp_ns, image))

    def take(self, frame: ImageFrame | FeatureFrame) -> Tracked:
        """Processes a frame, an image or named features; errors as of `track`."""
        last_ns = self.loss.stamp_ns if self.filter.stamp_ns is None else self.filter.stamp_ns
        stamp_ns = self.checked_stamp(frame.stamp_ns, last_ns)
        started = time.perf_counter()
        sensor, messages = self.sensor, list[str]()
        was_lost, never_found, first_new = sensor.lost, self.loss.never_found, len(sensor.table)

        self.hand_over.tune(self.filter, sensor)

        # 1. Check the input.
        has_images = len(sensor.table) > 0
        is_mapped = self.filter.belief().map.ids.size > 0
        if self.filter.steps and is_mapped and has_images != isinstance(frame, ImageFrame):
            raise InputError("a run takes images or named features, not both")
        measured: Measurement | FeatureFrame
        if isinstance(frame, FeatureFrame):
            frame.check(self.camera.dim)
            if (frame.landmarks < 0).any():
                raise InputError("a landmark has a negative name, number the landmarks from 0 on")
            measured, is_empty = frame, frame.landmarks.size == 0
        else:
            image, problem = self.screen.usable(frame.image)
            problem = frame.problem or problem
            if frame.image is None and problem is None:
                problem = "there is no image"
            messages += [] if problem is None else [problem]
            measured, is_empty = Measurement(stamp_ns, image, starting=not self.start.over), image is None
        self.filter.sensors = [sensor if isinstance(measured, Measurement) else self._named]

        # 2. The first frame initialises the known points.
        prior: PosePrior | None = None
        if not self.filter.steps:
            if is_empty and isinstance(self.known, KnownPixels):
                # Before the first usable image the camera is around the pose resected from them.
                assert self._start is not None
                self.loss.stamp_ns = stamp_ns
                pose, cov = self._start.world_from_camera, self.config.start_cov()
                values = {column.name: column.kind(0) for column in self.columns}
                messages.append("the run starts with the first image that shows the known points")
                waiting = TrackingState.INITIALISING, values | {"ess": float(self.config.particles)}
                return Tracked(stamp_ns, pose, cov, *waiting, self._nothing(), tuple(messages))
            measured, prior = self._begin(measured)
            self.loss.stamp_ns = stamp_ns

        # 3. Pose prior: by the motion model, unless nothing has been observed yet or the camera is lost.
        self.attempt = None
        if isinstance(measured, Measurement) and prior is None:
            if not len(sensor.table):
                at_rest = self.config.velocity.start_std()
                prior = PosePrior(SE3.identity(), np.zeros((6, 6)), at_rest)
            elif sensor.lost:
                prior, self.attempt = self.loss.prior(self.filter, measured.image)
                measured.recognised = self.attempt is not None and self.attempt.certain
                if self.joint is not None and self.attempt is not None and measured.image is not None:
                    pose, cov = self.loss.trusted
                    lost = Estimate(pose, cov + self.loss.drift(stamp_ns))
                    asked = self.filter, self.joint, measured.image, self.attempt, lost
                    is_known, found = self.place_recognition.relocalise(*asked)
                    measured.recognised, prior = measured.recognised or is_known, found or prior

        if prior is not None and self.joint is not None:  # its states are in a frame of its own
            frame_of_states = self.joint.world(SE3.identity((self.filter.n,)))
            prior = replace(prior, mean=SE3.between(frame_of_states, prior.mean))

        # 4. Named features of old sub-maps return before the frame that observes them, which ends the window.
        if self.joint is not None and self.joint.old.maps and isinstance(measured, FeatureFrame):
            expected = self.filter.expect(stamp_ns=stamp_ns)
            if self.features.bring_back(self.joint, measured, expected):
                self.filter.consolidate()

        # 5. The filter's step: active search, proposal, weights, samples, landmarks; see `ImageSensor`.
        report = self.report = self.filter.step(measured, prior, stamp_ns)
        if isinstance(measured, Measurement):
            self.measurement = measured
            if not sensor.bad_frames:
                self.loss.trust(self.filter, measured.image)

        # 6. Report.
        world = world_of(self.filter)
        if self.joint is not None:
            estimate = self.joint.estimate(self.filter.particles)
            pose, cov = estimate.mean, estimate.cov
        elif world is None:  # the refined mixture's
            pose, cov = report.estimate.mean[:7], report.estimate.cov[:6, :6]
        else:  # the samples', each in its own uncertain world, with which the pose is correlated before sampling
            particles = self.filter.particles
            estimate = relative_estimate(SE3, world, particles.state[:, :7], particles.log_weights)
            pose, cov = estimate.mean, estimate.cov
        if sensor.lost:
            cov = cov + self.loss.drift(stamp_ns)
        shown = frame if isinstance(frame, FeatureFrame) else measured
        values = self._values(shown, report)
        observed = self._observed(shown, world, first_new)

        seen = measured.features if isinstance(measured, Measurement) else frame
        assert isinstance(seen, FeatureFrame)
        # 7. Until depths are known: batch adjustment of the frames so far, and particles drawn from it; then the joint map,
        # if configured. Its frame is fixed from the first frame without measurements on.
        revision: Revision | None = None
        if not self.start.over or self.hand_over.is_ahead:
            # Initial value of an adjustment: the mixture before sampling, free of the particles' sampling noise.
            is_joint = self.joint is not None
            self.first.note(seen, pose if is_joint else mixture_estimate(*report.mixture).mean[:7])
            is_usable, is_lost = not sensor.bad_frames, sensor.lost and len(sensor.table) > 0
            become = partial(self.hand_over.become, sensor) if self.hand_over.is_ahead else None
            adjusted, words = self.start.after_frame(self.filter, is_usable, is_lost, become)
            messages = [words, *messages] if words is not None else messages
            if adjusted is None and self.start.over and is_usable:
                used = measured.used if isinstance(measured, Measurement) else measured
                adjusted = self.hand_over.after_frame(self.filter, sensor, used)
            if adjusted is not None:
                self.filter, revision = adjusted.filter, adjusted.revision
                pose, cov = revision.poses[-1], revision.covs[-1]
                if isinstance(measured, Measurement):
                    sensor.resampled(self.filter.belief(), *adjusted.seen_first)
                    self.loss.trust(self.filter, measured.image)
            if self.start.over and not self.hand_over.is_ahead:
                self.first.clear()
        self.hand_over.hold(self.filter, sensor.bad_frames > 0)

        if self.joint is not None and not sensor.bad_frames:
            image, used = (measured.image, measured.used) if isinstance(measured, Measurement) else (None, measured)
            if self.place_recognition.come_back(self.filter, self.joint, image, used):
                messages.append(COME_BACK)
                self.loss.trust(self.filter, image)
                estimate = self.joint.estimate(self.filter.particles)
                pose, cov = estimate.mean, estimate.cov

        # 8. Tracking state.
        if sensor.lost and not was_lost:
            messages.append(LOST)
        is_found = was_lost and not sensor.lost
        if is_found:
            messages.append(FOUND_IN_MAP if never_found else FOUND_AGAIN)
        values["relocalised"] = is_found and not never_found
        state = TrackingState.TRACKED if self.start.over else TrackingState.INITIALISING
        if sensor.lost:
            state = TrackingState.LOST
        elif is_empty or sensor.bad_frames:
            state = TrackingState.PREDICTED
        spent = time.perf_counter() - started
        values["seconds_filter"] = spent - values["seconds_search"] - values["seconds_new_landmarks"]
        return Tracked(stamp_ns, pose, cov, state, values, observed, tuple(messages), revision)

    def map(self) -> MapEstimate:
        """Points, and features of unknown depth as Gaussians, in the reported world.

        Columns: `ray`; `known`, whether it was given; of images, `attempts` and `found`, how often it was looked for.
        """
        found = estimate_mono_map(self.filter, self.features, world_of(self.filter))
        known, table = self.known_points, self.sensor.table
        columns = dict(found.columns)
        columns["known"] = np.isin(found.ids, [] if known is None else known.names).astype(int)
        if len(table):
            columns |= {"attempts": table.attempts[found.ids], "found": table.found[found.ids]}
        return replace(found, columns=columns)

    def particle_poses(self) -> np.ndarray:
        """(N, 7) world_from_camera of the current particles, in the reported world."""
        poses, world = super().particle_poses(), world_of(self.filter)
        return poses if world is None else SE3.between(world.mean, poses)

    def particle_paths(self) -> np.ndarray:
        """(T, N, 7) world_from_camera of the particles along their ancestors, in the reported world; with a lag, the last.

        With known points, each particle's path is reported relative to its own mean of their frame. Particles of a joint map
        have no paths, only their current poses.
        """
        if self.joint is not None:
            return self.particle_poses()[None]
        paths, world = self.filter.history.paths()[..., :7], world_of(self.filter)
        return paths if world is None else SE3.between(world.mean, paths)

    def measurements(self, name: str, log: FrameLog) -> FeatureLog:
        """The features used, and those that initialised landmarks, by their numbers, with the learnt noise.

        A frame with too few agreeing matches has none.
        """
        frames = []
        for t, (stamp_ns, used) in enumerate(zip(log.stamps_ns.tolist(), log["found"].tolist(), strict=True)):
            seen = log.observed(t)
            kept = np.isfinite(seen["px"]).all(axis=1) & bool(used)
            names = np.concatenate([seen["features"][kept], seen["started"]])
            px = np.concatenate([seen["px"][kept], seen["started_px"]])
            noise = np.tile(self.config.search.noise_px**2 * np.eye(2), (seen["started"].size, 1, 1))
            cov = self.features.noisy(names, np.concatenate([seen["cov_px"][kept], noise]))
            frames.append(FeatureFrame(stamp_ns, names, px, cov))
        found = self.hand_over.calibration(self.filter)
        return FeatureLog(name, self.camera if found is None else found[0], frames, self.known_points)

    def summary(self, log: FrameLog) -> dict[str, Any]:
        """Counts of tracked frames, landmarks and matches."""
        lost, searched, found, landmarks = log.lost(), log["searched"], log["found"], self.map()
        tracked, looked = np.flatnonzero(~lost), searched > 0
        localised = {"localized": True, "found_at_frame": int(tracked[0]) if tracked.size else None}
        # Self-calibration: px or no unit, with standard deviations; None as long as there is no estimate.
        calibration: dict[str, Any] = {} if self.config.calibrate == "off" else {"calibration": None}
        if (calibrated := self.hand_over.calibration(self.filter)) is not None:
            camera, std = calibrated
            units = np.array([camera.fx, camera.fy, 1.0, 1.0])
            each = zip(NUMBERS, camera.params[[0, 1, 4, 5]].tolist(), (units * std).tolist(), strict=True)
            pairs = (pair for name, at, spread in each for pair in ((name, at), (f"std_{name}", spread)))
            calibration["calibration"] = dict(pairs)
        return {
            "frames_tracked": int((~lost).sum()),
            "lost_frames": int(lost.sum()),
            "relocalisations": int(log["relocalised"].sum()),
            "map": "particles" if self.joint is None else "joint",
            "noise_factor": float(np.sqrt(self.features.noise_factor)),
            **calibration,
            "known_points": 0 if self.known_points is None else int(self.known_points.names.size),
            **({} if self.known_map is None else localised),
            "landmarks_full": int((~landmarks.is_ray()).sum()),
            "landmarks_partial": int(landmarks.is_ray().sum()),
            "observations_per_frame": float(found.mean()),
            "share_found": float(found[looked].sum() / searched[looked].sum()) if looked.any() else 0.0,
        }

    def files(self, log: FrameLog) -> Mapping[str, dict[str, np.ndarray] | str]:
        """The particles' paths; for images the known map, unless the run was localised; the self-calibrated camera.

        The camera of a run that has calibrated it.
        """
        posterior = {
            "stamps_ns": self.filter.history.stamps_ns if self.joint is None else np.array([self.filter.stamp_ns]),
            "world_from_camera": self.particle_paths(),
            "log_weights": self.filter.particles.log_weights,
        }
        files: dict[str, dict[str, np.ndarray] | str] = {"posterior.npz": posterior}
        if (found := self.hand_over.calibration(self.filter)) is not None:
            files[CAMERA] = camera_text(
                found[0], "focal lengths, k1 and k2 as the run estimated them, calibrate=online"
            )
        if self.known_map is None and len(self.sensor.table):
            files[NAME] = known_map_arrays(self.export_map(log.poses[~log.lost()]))
        return files

    def export_map(self, poses: np.ndarray) -> KnownMap:
        """The map for localising later runs, with some of the tracked poses (T, 7) as viewpoints.

        It has the points of known depth still in the map, with their appearances.
        """
        found, table, world = self.map(), self.sensor.table, world_of(self.filter)
        is_lasting = table.alive[found.ids]
        if self.joint is not None:
            is_lasting |= ~table.failing(found.ids, self.config.search)
        kept = np.flatnonzero(~found.is_ray() & is_lasting)
        rows, positions = found.ids[kept], found.mean[kept]
        first = table.first_pose[rows]
        if world is not None:
            first = SE3.compose(SE3.inverse(world.mean[self.filter.belief().mode]), first)
        looks = table.first_patch[rows], table.first_px[rows], first
        views = distant_views(positions, poses)
        return KnownMap(self.features.camera, self.gauge, rows, positions, found.cov[kept], *looks, views)

    def arrays(self) -> dict[str, np.ndarray]:
        """The sensor's table, the last trusted pose, and the first frames while they are kept."""
        arrays: dict[str, np.ndarray] = {}
        for part in (self.sensor, self.screen, self.loss, self.first, self.start, self.hand_over):
            arrays |= part.arrays()
        return arrays

    def load(self, path: Path | str) -> dict[str, np.ndarray]:
        """As `System.load`; a checkpoint with a joint map has another filter."""
        self.filter = self.hand_over.taken_up(Path(path), self.sensor, self.filter.rng) or self.filter
        return super().load(path)

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        for part in (self.sensor, self.screen, self.loss, self.first, self.start, self.hand_over):
            part.restore(arrays)
        self.hand_over.hold(self.filter, self.sensor.bad_frames > 0)
        table, landmark_map = self.sensor.table, self.filter.belief().map
        own = np.flatnonzero(table.alive & (table.member < 0))
        if not landmark_map.holds(own).all():
            raise InputError("a feature of the table is alive and not in the map")
        if len(table) and landmark_map.ids.max(initial=-1) >= len(table):
            raise InputError("a landmark of the map is not in the table of features")

    def _new_filter(self, sensor: Sensor) -> Filter:
        """A filter with an empty map and registered parametrisations, so that a checkpoint can be loaded."""
        config, velocity = self.config, self.config.velocity
        motion: MotionModel = MarginalVelocity(velocity.walk_std())
        if velocity.mode != "marginal":
            motion = SampledVelocity(velocity.walk_std(), velocity.mode, velocity.start_std())
        landmark_map = LandmarkMap(motion.space, compiled=config.compiled)
        landmark_map.register(Point(3))
        landmark_map.register(self.features.unknown_depth.landmark)
        if self.features.group is not None:
            landmark_map.register(Constellation(self.features.group.positions, self.features.group.cov))
        parts: list[Conditional] = [landmark_map]
        if velocity.mode == "marginal":
            parts.append(KalmanSubstate(SE3, np.zeros(6), np.diag(velocity.start_std() ** 2)))
        return self.new_filter(motion, sensor, parts, config.proposal.build())

    def _begin(self, measured: Measurement | FeatureFrame) -> tuple[Measurement | FeatureFrame, PosePrior | None]:
        """The first frame's measurement, and the camera's pose: the origin, unless known points define the world."""
        known, config = self.known, self.config
        if self.known_map is not None:
            return measured, None
        if known is None:
            return measured, PosePrior(SE3.identity(), np.zeros((6, 6)))

        # The known points in the frame.
        if isinstance(measured, Measurement):
            if not isinstance(known, KnownPixels):
                raise InputError("known points without pixels are those of named features: images need KnownPixels")
            assert self._start is not None and measured.image is not None
            start = self._start
            require_texture(measured.image, known)
            self.sensor.begin(measured.image, known.px, self.features.group is not None)
            measured.known_px = known.px
        else:
            if not isinstance(known, KnownPoints):
                raise InputError("known points with pixels are those of an image: named features need KnownPoints")
            start = KnownStart.from_frame(self.camera, known, measured)

        if self.features.group is None:
            # Separate landmarks, in a world whose pose each particle samples in the first frame: the prior is wide, and the
            # frame's measurements, not the resection, determine the camera's pose in it.
            self._add_points(start.points)
            return measured, PosePrior(start.world_from_camera, config.start_cov())

        # One landmark, initialised by the frame's observations, which are not used again.
        landmark_map, group = self.filter.belief().map, Constellation(start.points.positions, start.points.cov)
        records = constellation_records(self.camera, start, group, self.filter.n, config.start_cov())
        landmark_map.add_records(records, group, ids=start.points.names[:1])
        if isinstance(measured, FeatureFrame):
            measured = measured.take(~np.isin(measured.landmarks, start.points.names))
        return measured, PosePrior(SE3.identity(), np.zeros((6, 6)))

    def _add_points(self, known: KnownPoints) -> None:
        """Adds them to the map once, with their σ, as ordinary landmarks."""
        landmark_map, n = self.filter.belief().map, self.filter.n
        mean = np.broadcast_to(known.positions, (n, *known.positions.shape))
        cov = np.broadcast_to(known.cov, (n, *known.cov.shape))
        landmark_map.add_records(Records(mean, cov), Point(3), ids=known.names)

    def _values(self, measured: Measurement | FeatureFrame, report: StepReport) -> dict[str, Any]:
        """Values of `columns`, except `relocalised` and the time of the rest."""
        landmark_map = self.filter.belief().map
        rays = int(landmark_map.are(landmark_map.ids, self.features.unknown_depth.landmark).sum())
        seconds_search = seconds_new = 0.0
        if isinstance(measured, Measurement):
            searched, found = measured.search.features.size, measured.used.landmarks.size
            seconds_search, seconds_new = measured.seconds_search, measured.seconds_new_landmarks
        else:
            searched = measured.landmarks.size
            found = int(self.camera.inside(measured.z).sum())
        return {
            "searched": searched,
            "found": found,
            "lost": self.sensor.lost,
            **filter_values(report),
            "points": landmark_map.ids.size - rays,
            "rays": rays,
            "seconds_search": seconds_search,
            "seconds_new_landmarks": seconds_new,
        }

    def _observed(
        self, measured: Measurement | FeatureFrame, world: Anchored | None, first_new: int
    ) -> dict[str, np.ndarray]:
        """Values of `observed`, in the heaviest particle."""
        if isinstance(measured, FeatureFrame):
            nowhere = {each.name: np.full((len(measured.z), *each.shape), np.nan) for each in self.observed[1:-2]}
            seen = {"features": measured.landmarks, "px": measured.z, "cov_px": measured.cov_z}
            return self._nothing() | nowhere | seen
        belief, table, search = self.filter.belief(), self.sensor.table, measured.search
        rows, found, pose = search.features, search.found, self.features.pose(belief)
        position = table.position[rows].copy()
        if world is not None:
            position[:, :3] = directions(position, world.mean[belief.mode])
        position[~found] = np.nan
        line = np.full((rows.size, 2, 2), np.nan)
        unknown, ends = self.features.extents(belief, rows, LINE_SIGMAS)
        if unknown.size:
            direction = directions(ends.reshape(-1, 4), pose)
            px = self.features.camera.project(direction)
            px[~(direction[:, 2] > 0.0)] = np.nan
            line[unknown] = px.reshape(-1, 2, 2)
        return {
            "features": rows,
            "mean": search.mean,
            "cov": search.cov,
            "px": np.where(found[:, None], search.px, np.nan),
            "cov_px": np.tile(self.config.search.noise_px**2 * np.eye(2), (rows.size, 1, 1)),
            "line": line,
            "position": position,
            "started": np.arange(first_new, len(table)),
            "started_px": table.first_px[first_new:].copy(),
        }

    def _nothing(self) -> dict[str, np.ndarray]:
        return {each.name: np.zeros((0, *each.shape), dtype=each.kind) for each in self.observed}
