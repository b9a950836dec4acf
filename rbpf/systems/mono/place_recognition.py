"""Has the camera been here before? Old sub-maps are recognised by appearance, and judged by evidence.

What is expected in view is looked for (`ImageSensor`). A camera that is lost, or so unsure of its place that nothing can
be expected, asks the old sub-maps: corners of the image vote for those whose landmarks look like them, and the camera is
looked for in the best ones as in any map (`Relocaliser`). What comes out is a hypothesis: this is the same place, seen
from a pose that the joint map thinks possible. There are two others: the matches are chance; or another place looks
alike, which may be anywhere. They are weighed by the likelihood of all matches, Mathematics (same-place), and a loop is
closed once it is sure. Until then the camera waits for a better view: an old map loses nothing by waiting, and a wrong loop
cannot be taken back.
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

WRONG = 0.5  #: Matches that are wrong by what is expected beforehand, as a fraction, and may be anywhere in the image.
BEFORE = 1e-3  #: Probability, when it is asked, that an old sub-map is in view; with the rest the matches are chance.
ALIKE = 0.01  #: Probability that another place looks like it, somewhere in a world as large as the map.
#: Probability of its being another place at which a loop is closed; of a camera that is lost, which has less to lose.
RISK, RISK_LOST = 1e-3, 5e-2
FURTHER = 3.0  #: Times the standard deviation of how far a lost camera has gone: some are thrown.
ASKED = 2  #: Old sub-maps that are asked in a frame.
VOTERS = 150  #: Corners of an image that say which ones.
EXACT = 1e-4  #: Standard deviation [rad, m] of where a lost camera is in a sub-map that begins where it is.
ROUNDS = 8
#: Standard deviation of the range of what a single image shows, which has none, as a fraction of what is assumed.
DEPTH_RATIO = 10.0


class Place(NamedTuple):
    """A sub-map of landmarks alone, and where its end is."""

    world_from_place: np.ndarray
    held: SubMap

    @classmethod
    def of(cls, joint: JointMap, number: int | None = None) -> "Place":
        """The old one of this number, or the present one, whose end is the frame."""
        if number is None:
            held, pose = joint.finished(), joint.world(SE3.identity((1,)), slice(1))[0]
        else:
            held, pose = joint.old.maps[number], joint.old.starts[number + 1]
        return cls(pose, held.of(np.flatnonzero(held.ids >= 0)))

    def at(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (M, 3), as seen from the end, and covariances (M, 3, 3) of landmarks (M,)."""
        rows = self.held.rows(names)
        columns = SE3.dim + 3 * rows[:, None] + np.arange(3)
        return self.held.points[rows], self.held.cov[columns[:, :, None], columns[:, None]]


def log_likelihood(
    camera: Pinhole, pose: np.ndarray, points: np.ndarray, cov: np.ndarray, px: np.ndarray, prior: Estimate | None
) -> tuple[float, np.ndarray]:
    """Log p(px | place) less that of chance, where px (M, 2) may show points (M, 3) of covariance (M, 3, 3); Laplace's.

    The pose (7,) of the camera among the points is integrated over its prior, from a first guess on; without a prior over a
    density of 1. Returns the mode (7,), too. Mathematics (same-place).
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
    """Of being where the points (M, 3) are, against being elsewhere; and the most probable pose (7,) among them if so.

    Arguments as `log_likelihood`. Another place that looks alike may be anywhere in a map of this size (3,), however turned.
    """
    same, mode = log_likelihood(camera, pose, points, cov, px, prior)
    alike = log_likelihood(camera, pose, points, cov, px, None)[0]
    # It is nowhere more probable than this place is at best, as it would be were the camera's pose hardly known.
    peak = -0.5 * np.linalg.slogdet(2.0 * np.pi * prior.cov)[1]
    alike += min(peak, -np.log(8.0 * np.pi**2 * np.prod(size_m))) + np.log(ALIKE)
    return same - float(np.logaddexp(alike, -np.log(BEFORE))), mode


@final
class PlaceRecognition:
    """Asks the old sub-maps of a joint map where the camera is."""

    def __init__(self, relocaliser: Relocaliser, config: MonoConfig) -> None:
        self.relocaliser, self.sensor, self.config = relocaliser, relocaliser.sensor, config.relocalisation
        self._std_velocity = config.velocity.start_std()
        self.features = self.sensor.features
        self._described: dict[int, np.ndarray] = {}  # by row: how a landmark looked at first

    def come_back(self, filter_: Filter, joint: JointMap, image: np.ndarray | None, seen: FeatureFrame) -> bool:
        """Closes a loop if a tracked camera that does not know where to look is where it has been.

        The image (H, W) is asked every so many frames, or, without one, the names of features that were seen.
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
                for number in self._ask(joint, image)
                if np.isin(seen.landmarks, joint.old.maps[number].ids).sum() < MIN_FITTED
            ]
        for number, sighting in found:
            # Evidence alone is not asked of fewer than what a relocalisation takes: its own errors grow as matches get few.
            if sighting is None or (image is not None and len(sighting.agreeing[0]) < self.config.min_inliers):
                continue
            filter_.consolidate()
            prior = joint.old.relative(number, joint.finished())
            # Names are believed.
            again = self._judged(joint, Place.of(joint, number), sighting, prior, 1.0 if image is None else RISK)
            if again is not None:
                self._close(joint, again, tied=True)
                return True
        return False

    def relocalise(
        self, filter_: Filter, joint: JointMap, image: np.ndarray, attempt: Attempt, lost: Estimate
    ) -> tuple[bool, PosePrior | None]:
        """Whether a lost camera is recognised, and its pose where that is in an old sub-map, from which another one begins.

        An attempt was made to find it in the present one; `lost` says where it may be.
        """
        if attempt.prior is not None and attempt.sighting is not None:
            present = Place.of(joint)
            prior = Estimate(SE3.between(present.world_from_place, lost.mean), FURTHER**2 * lost.cov)
            return self._odds(joint, present, attempt.sighting, prior)[0] >= -np.log(RISK_LOST), None
        # In an old sub-map, perhaps: then another one begins there.
        y = SE3.between(joint.world(SE3.identity((1,)), slice(1))[0], lost.mean)
        for number in self._ask(joint, image) if joint.old.maps else []:
            sighting = self._look(filter_, joint, image, number)
            if sighting is None:
                continue
            frame, turn = joint.old.relative(number, joint.finished()), SE3.adjoint(SE3.inverse(y))
            prior = Estimate(SE3.compose(frame.mean, y), turn @ frame.cov @ turn.T + FURTHER**2 * lost.cov)
            again = self._judged(joint, Place.of(joint, number), sighting, prior, RISK_LOST, self.config.std_inflation)
            if again is not None:
                joint.consolidate(Particles(SE3.identity((filter_.n,)), filter_.particles.log_weights))
                self._close(joint, again, tied=False)
                filter_.particles = Particles(SE3.identity((filter_.n,)), uniform_log_weights(filter_.n))
                here = joint.world(SE3.identity((filter_.n,)))
                return True, PosePrior(here, EXACT**2 * np.eye(6), self._std_velocity)
        return False, None

    def _close(self, joint: JointMap, again: Given, tied: bool) -> None:
        """Closes the loop; how features looked from where goes with the sub-map that they are of, or with the frame."""
        old, table = joint.old, self.sensor.table
        before, frame = np.array(old.starts), joint.world(SE3.identity((joint.n,)))[0]
        rows, numbers = old.latest()
        joint.recognise(again, tied)
        # The sub-map that was the present one ends at the frame.
        moved = SE3.compose(
            np.array(old.starts)[1 : len(before) + 1], SE3.inverse(np.append(before[1:], frame[None], axis=0))
        )
        of_row = np.full(len(table), len(before) - 1)
        if len(table):
            of_row[rows] = numbers
            self.sensor.move(moved[of_row])

    def _named(self, filter_: Filter, joint: JointMap, seen: FeatureFrame) -> tuple[int, Sighting | None]:
        """Features that carry names say where they are seen from: the old sub-map that has most of them."""
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
        """Where the image was taken if it shows an old sub-map, seen from where that ended."""
        place = Place.of(joint, number)
        among = place.held.ids, SE3.transform(place.world_from_place, place.held.points)
        return self.relocaliser.find(filter_.belief(), image, place.world_from_place, None, among).sighting

    def _ask(self, joint: JointMap, image: np.ndarray) -> np.ndarray:
        """Numbers of the old sub-maps that an image looks like, the best first.

        Each corner votes for the one that has the landmark most like it, by how much more alike that is than any of
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
        """`log_odds` of a place where the image was sighted, and the pose (7,) in it."""
        held = np.isin(sighting.matches[0], place.held.ids)
        names, px = (each[held] for each in sighting.matches)
        pose = SE3.between(place.world_from_place, sighting.world_from_camera)
        every = np.concatenate([joint.old.places()[1], SE3.transform(place.world_from_place, place.held.points)])
        return log_odds(self.features.camera, pose, *place.at(names), px, prior, np.ptp(every, axis=0))

    def _judged(
        self, joint: JointMap, place: Place, sighting: Sighting, prior: Estimate, risk: float, wider: float = 1.0
    ) -> Given | None:
        """What is seen of an old sub-map's landmarks from the camera, if it is that place but for a risk."""
        odds, pose = self._odds(joint, place, sighting, prior)
        names, px = (each[~joint.holds(sighting.agreeing[0])] for each in sighting.agreeing)
        if names.size < MIN_FITTED or (risk < 1.0 and odds < -np.log(risk)):
            return None
        # As far away as the place says, in the direction in which it is seen: how far a single image does not tell.
        seen = SE3.inverse_transform(pose, place.at(names)[0])
        jac = self.features.camera.jacobian(seen) / (wider * sighting.noise_px)
        along = seen / (DEPTH_RATIO * np.square(seen).sum(axis=1, keepdims=True))
        info = np.swapaxes(jac, 1, 2) @ jac + along[:, :, None] * along[:, None]
        rays = np.insert(self.features.camera.unproject(px), 2, 1.0, axis=1)
        return Given(names, rays * seen[:, 2:], block_diag(*np.linalg.inv(info)))
