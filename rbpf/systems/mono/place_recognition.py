"""Place recognition and loop closure: old sub-maps are recognised by appearance, and verified by evidence.

Features predicted in view are searched (`ImageSensor`). A camera that is lost, or too uncertain for predictions, queries the
old sub-maps: corners of the image vote for those with similar landmarks, and the camera is relocalised in the best ones
(`Relocaliser`). The result is a hypothesis: this is the same place, seen from a pose that is plausible for the joint map. The
alternatives are that the matches are chance, or that another, similar place anywhere is seen. The likelihood of all matches
decides, Mathematics (same-place), and a loop is closed once it is certain. Until then the camera waits for a better view:
waiting costs nothing, whereas a wrong loop closure cannot be undone.
"""

from typing import NamedTuple, final

import numpy as np
from scipy.linalg import block_diag

from rbpf import gaussian
from rbpf.core.filter import Filter
from rbpf.core.particles import Estimate, Particles, uniform_log_weights
from rbpf.lie import SE3
from rbpf.maps.joint.solution import Given, SubMap
from rbpf.maps.joint_map import JointMap
from rbpf.motion.constant_velocity import PosePrior
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.resection import resect_consensus
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.features.interface import WINDOW_SCALE_PX
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.relocalisation import CORNER_PX, MIN_FITTED, SCALES, Attempt, Relocaliser, Sighting

WRONG = 0.5  #: Prior fraction of wrong matches, which may be anywhere in the image.
BEFORE = 1e-3  #: Prior probability that an old sub-map is in view; otherwise matches are by chance.
ALIKE = 0.01  #: Prior probability that another place looks like it, somewhere in a world as large as the map.
#: Risk of another place at which a loop is closed; and for a lost camera, which has less to lose.
RISK, RISK_LOST = 1e-3, 5e-2
FURTHER = 3.0  #: Factor on the standard deviation of a lost camera's motion, as it may have been moved quickly.
ASKED = 2  #: Old sub-maps queried per frame.
VOTERS = 150  #: Corners of an image that vote for them.
EXACT = 1e-4  #: Standard deviation [rad, m] of a lost camera's pose in a sub-map that starts there.
ROUNDS = 8
#: Standard deviation of ranges assumed for a single image, as a fraction of them.
DEPTH_RATIO = 10.0


class Place(NamedTuple):
    """A sub-map's landmarks, and the pose of its end."""

    world_from_place: np.ndarray
    held: SubMap

    @classmethod
    def of(cls, joint: JointMap, number: int | None = None) -> "Place":
        """The old sub-map of this number, or the current one, whose end is the frame."""
        if number is None:
            held, pose = joint.finished(), joint.world(SE3.identity((1,)), slice(1))[0]
        else:
            held, pose = joint.old.maps[number], joint.old.starts[number + 1]
        return cls(pose, held.of(np.flatnonzero(held.ids >= 0)))

    def at(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (M, 3), relative to the end, and covariances (M, 3, 3) of landmarks (M,)."""
        rows = self.held.rows(names)
        columns = SE3.dim + 3 * rows[:, None] + np.arange(3)
        return self.held.points[rows], self.held.cov[columns[:, :, None], columns[:, None]]


def log_likelihood(
    camera: Pinhole, pose: np.ndarray, points: np.ndarray, cov: np.ndarray, px: np.ndarray, prior: Estimate | None
) -> tuple[float, np.ndarray]:
    """Log p(px | place) − log p(px | chance) of matches px (M, 2) with points (M, 3), covariance (M, 3, 3), by Laplace.

    The pose (7,) of the camera relative to the points is integrated over its prior, starting from a first guess; without a
    prior over a density of 1. Also returns the mode (7,). Mathematics (same-place).
    """
    area = float(camera.width * camera.height)
    known = np.zeros((6, 6)) if prior is None else gaussian.inverse(prior.cov)
    for _ in range(ROUNDS):
        seen = SE3.inverse_transform(pose, points)
        jac = camera.jacobian(seen)
        by_point = jac @ SE3.rotation(pose).T
        spread = by_point @ cov @ np.swapaxes(by_point, 1, 2) + CORNER_PX**2 * np.eye(2)
        miss = px - camera.project(seen)
        weighed = np.linalg.solve(spread, miss[..., None])[..., 0]
        density = area * np.exp(-0.5 * (miss * weighed).sum(axis=1)) / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
        right = (1.0 - WRONG) * np.where(seen[:, 2] > 0.0, density, 0.0)
        by_pose = -jac @ SE3.transform_jacobian(seen)
        share = right / (right + WRONG)
        off = np.zeros(6) if prior is None else SE3.local(prior.mean, pose)
        back = SE3.right_jacobian_inverse(off)
        info = np.einsum("m,mpa,mpq,mqb->ab", share, by_pose, np.linalg.inv(spread), by_pose) + back.T @ known @ back
        gradient = np.einsum("m,mpa,mp->a", share, by_pose, weighed) - back.T @ known @ off
        total = float(np.log(right + WRONG).sum())
        values = np.linalg.eigvalsh(info)
        if not values[0] > 1e-12 * values[-1]:
            return -np.inf, pose
        at = pose
        pose = SE3.retract(pose, np.linalg.solve(info, gradient))
    total -= 0.5 * float(np.log(values / (2.0 * np.pi)).sum())
    if prior is not None:
        total += float(-0.5 * off @ known @ off - 0.5 * np.linalg.slogdet(2.0 * np.pi * prior.cov)[1])
    return total, at


def log_odds(
    camera: Pinhole,
    pose: np.ndarray,
    points: np.ndarray,
    cov: np.ndarray,
    px: np.ndarray,
    prior: Estimate,
    size_m: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Log-odds of being at the points (M, 3), against being elsewhere; and the most probable pose (7,) if so.

    Arguments as of `log_likelihood`. A similar place may be anywhere in a map of this size (3,), at any orientation.
    """
    same, mode = log_likelihood(camera, pose, points, cov, px, prior)
    alike = log_likelihood(camera, pose, points, cov, px, None)[0]
    # Its uniform pose density is limited to the peak density of the prior.
    peak = -0.5 * np.linalg.slogdet(2.0 * np.pi * prior.cov)[1]
    alike += min(peak, -np.log(8.0 * np.pi**2 * np.prod(size_m))) + np.log(ALIKE)
    return same - float(np.logaddexp(alike, -np.log(BEFORE))), mode


@final
class PlaceRecognition:
    """Localises the camera in the old sub-maps of a joint map."""

    def __init__(self, relocaliser: Relocaliser, config: MonoConfig) -> None:
        self.relocaliser, self.sensor, self.config = relocaliser, relocaliser.sensor, config.relocalisation
        self._std_velocity = config.velocity.start_std()
        self.features = self.sensor.features
        self._described: dict[int, np.ndarray] = {}  # by row: descriptor of a landmark's first appearance

    def come_back(self, filter_: Filter, joint: JointMap, image: np.ndarray | None, seen: FeatureFrame) -> bool:
        """Closes a loop if a tracked camera of uncertain pose has returned to a known place.

        It uses the image (H, W) every few frames, or without one the names of observed features.
        """
        if not joint.old.maps or not self.features.is_unsure(joint):
            return False
        if image is None:
            amiss = np.flatnonzero(self.features.amiss(filter_.belief(), seen))
            found = [self._named(filter_, joint, seen.take(amiss))] if amiss.size > MIN_FITTED else []
        elif filter_.steps % self.config.ask_every:
            return False
        else:
            found = [
                (number, self._look(filter_, joint, image, number))
                for number in self._vote(joint, image)
                if np.isin(seen.landmarks, joint.old.maps[number].ids).sum() < MIN_FITTED
            ]
        for number, sighting in found:
            # A minimum number of matches is required besides, as the evidence is unreliable with few.
            if sighting is None or (image is not None and len(sighting.agreeing[0]) < self.config.min_inliers):
                continue
            filter_.consolidate()
            prior = joint.old.relative(number, joint.finished())
            # Names are taken as certain.
            again = self._verified(joint, Place.of(joint, number), sighting, prior, 1.0 if image is None else RISK)
            if again is not None:
                self._close(joint, again, tied=True)
                return True
        return False

    def relocalise(
        self, filter_: Filter, joint: JointMap, image: np.ndarray, attempt: Attempt, lost: Estimate
    ) -> tuple[bool, PosePrior | None]:
        """Whether a lost camera is relocalised in an old sub-map, at which a new sub-map then starts; and its pose.

        Relocalisation in the current one has been tried before; `lost` has the pose prior.
        """
        if attempt.prior is not None and attempt.sighting is not None:
            present = Place.of(joint)
            prior = Estimate(SE3.between(present.world_from_place, lost.mean), FURTHER**2 * lost.cov)
            return self._odds(joint, present, attempt.sighting, prior)[0] >= -np.log(RISK_LOST), None
        # Try old sub-maps; on success a new sub-map starts there.
        y = SE3.between(joint.world(SE3.identity((1,)), slice(1))[0], lost.mean)
        for number in self._vote(joint, image) if joint.old.maps else []:
            sighting = self._look(filter_, joint, image, number)
            if sighting is None:
                continue
            frame, turn = joint.old.relative(number, joint.finished()), SE3.adjoint(SE3.inverse(y))
            prior = Estimate(SE3.compose(frame.mean, y), turn @ frame.cov @ turn.T + FURTHER**2 * lost.cov)
            again = self._verified(
                joint, Place.of(joint, number), sighting, prior, RISK_LOST, self.config.std_inflation
            )
            if again is not None:
                joint.consolidate(Particles(SE3.identity((filter_.n,)), filter_.particles.log_weights))
                self._close(joint, again, tied=False)
                filter_.particles = Particles(SE3.identity((filter_.n,)), uniform_log_weights(filter_.n))
                here = joint.world(SE3.identity((filter_.n,)))
                return True, PosePrior(here, EXACT**2 * np.eye(6), self._std_velocity)
        return False, None

    def _close(self, joint: JointMap, again: Given, tied: bool) -> None:
        """Closes the loop; viewpoints of features move with their sub-map, or with the frame."""
        old, table = joint.old, self.sensor.table
        before, frame = np.array(old.starts), joint.world(SE3.identity((joint.n,)))[0]
        rows, numbers = old.latest()
        joint.recognise(again, tied)
        # The previous sub-map ends at the frame.
        moved = SE3.compose(
            np.array(old.starts)[1 : len(before) + 1], SE3.inverse(np.append(before[1:], frame[None], axis=0))
        )
        of_row = np.full(len(table), len(before) - 1)
        if len(table):
            of_row[rows] = numbers
            self.sensor.move(moved[of_row])

    def _named(self, filter_: Filter, joint: JointMap, seen: FeatureFrame) -> tuple[int, Sighting | None]:
        """Localises by named features in the old sub-map with most of them."""
        number = int(np.argmax([np.isin(seen.landmarks, held.ids).sum() for held in joint.old.maps]))
        place = Place.of(joint, number)
        rows = np.flatnonzero(np.isin(seen.landmarks, place.held.ids))
        names, px = seen.landmarks[rows], seen.z[rows]
        if rows.size < MIN_FITTED + 1:
            return number, None
        points = SE3.transform(place.world_from_place, place.at(names)[0])
        config = self.config
        found = resect_consensus(self.features.camera, points, px, config.inlier_px, config.p3p_samples, filter_.rng)
        if found is None:
            return number, None
        std = float(np.sqrt(np.diagonal(seen.cov_z[rows], axis1=1, axis2=2).mean()))
        agreeing = names[found.inliers], px[found.inliers]
        return number, Sighting(found.world_from_camera, (names, px), agreeing, std)

    def _look(self, filter_: Filter, joint: JointMap, image: np.ndarray, number: int) -> Sighting | None:
        """The image's pose relative to the end of an old sub-map, if it shows it."""
        place = Place.of(joint, number)
        among = place.held.ids, SE3.transform(place.world_from_place, place.held.points)
        return self.relocaliser.find(filter_.belief(), image, place.world_from_place, None, among).sighting

    def _vote(self, joint: JointMap, image: np.ndarray) -> np.ndarray:
        """Numbers of the old sub-maps similar to an image, the best first.

        Each corner votes for the one with the most similar landmark, weighted by the difference to the best landmark of
        another sub-map (local naive Bayes nearest neighbours, CVPR 2012).
        """
        rows, numbers = joint.old.latest()
        if not rows.size:
            return rows
        new = np.array([row for row in rows.tolist() if row not in self._described], dtype=np.int64)
        scale, patches = np.full(new.size, WINDOW_SCALE_PX), self.sensor.table.first_patch[new]
        described = self.sensor.descriptor.describe_windows(patches, scale, np.zeros(new.size))
        self._described |= dict(zip(new.tolist(), described, strict=True))
        known = np.array([self._described[row] for row in rows.tolist()])
        voters = self.relocaliser.corners(image)[1][SCALES.index(1.0), :VOTERS]
        alike = np.full((len(joint.old.maps), len(voters)), -1.0, dtype=np.float32)
        np.maximum.at(alike, numbers, known @ voters.T)
        best = alike.argmax(axis=0)
        top = np.sort(np.pad(alike, ((1, 0), (0, 0)), constant_values=-1.0), axis=0)[-2:]
        return np.argsort(-np.bincount(best, top[1] - top[0], len(alike)), kind="stable")[:ASKED]

    def _odds(self, joint: JointMap, place: Place, sighting: Sighting, prior: Estimate) -> tuple[float, np.ndarray]:
        """`log_odds` of a place given a sighting, and the pose (7,) in it."""
        held = np.isin(sighting.matches[0], place.held.ids)
        names, px = (each[held] for each in sighting.matches)
        pose = SE3.between(place.world_from_place, sighting.world_from_camera)
        every = np.concatenate([joint.old.places()[1], SE3.transform(place.world_from_place, place.held.points)])
        return log_odds(self.features.camera, pose, *place.at(names), px, prior, np.ptp(every, axis=0))

    def _verified(
        self, joint: JointMap, place: Place, sighting: Sighting, prior: Estimate, risk: float, wider: float = 1.0
    ) -> Given | None:
        """The sighting of an old sub-map's landmarks relative to the camera, if it is that place up to a risk."""
        odds, pose = self._odds(joint, place, sighting, prior)
        names, px = (each[~joint.holds(sighting.agreeing[0])] for each in sighting.agreeing)
        if names.size < MIN_FITTED or (risk < 1.0 and odds < -np.log(risk)):
            return None
        # Ranges are those of the place, directions those of the image, as a single image has no range.
        seen = SE3.inverse_transform(pose, place.at(names)[0])
        jac = self.features.camera.jacobian(seen) / (wider * sighting.noise_px)
        along = seen / (DEPTH_RATIO * np.square(seen).sum(axis=1, keepdims=True))
        info = np.swapaxes(jac, 1, 2) @ jac + along[:, :, None] * along[:, None]
        rays = np.insert(self.features.camera.unproject(px), 2, 1.0, axis=1)
        return Given(names, rays * seen[:, 2:], block_diag(*np.linalg.inv(info)))
