"""Positions and viewing conditions of landmarks, to select those in view; first views; limiting the map's size."""

from typing import ClassVar

import numpy as np

from rbpf.core.checkpoint import Kept, grey, numbers
from rbpf.core.models import Belief, Map
from rbpf.lie import SE3
from rbpf.maps.joint_map import JointMap
from rbpf.sensors.camera import RectifiedStereo
from rbpf.systems.stereo.config import MapConfig

SIGMAS = 3.0  #: Margin of the view in standard deviations of the camera's direction.


class Places(Kept):
    """Last observations of landmarks, common to all particles, to select candidates for a view.

    Landmarks are indexed by their rows in the manager.
    """

    place: np.ndarray  #: (M, 3) in the world of the heaviest particle.
    patch: np.ndarray  #: (M, S, S) uint8, first views as in `StereoFeatures`.
    first: np.ndarray  #: (M, 4), likewise.
    kept: ClassVar = {
        "place": numbers("landmarks", 3),
        "_seen_from": numbers("landmarks", 3),
        "patch": grey("landmarks", "side", "side"),
        "first": numbers("landmarks", 4),
    }
    prefix = "places/"

    def __init__(self, rig: RectifiedStereo, config: MapConfig) -> None:
        self.rig, self.config = rig, config
        self.place, self._seen_from = np.zeros((2, 0, 3))
        self.patch, self.first = np.zeros((0, 0, 0), np.uint8), np.zeros((0, 4))

    def add(self, patch: np.ndarray, first: np.ndarray) -> None:
        """Adds new landmarks with first views (k, S, S) and (k, 4); `put` sets their positions."""
        self.patch = np.concatenate([self.patch, patch]) if len(self.patch) else patch
        self.first = np.concatenate([self.first, first])

    def put(self, rows: np.ndarray, place: np.ndarray, world_from_camera: np.ndarray) -> None:
        """Landmarks (k,), old or new, are observed at (k, 3) in the heaviest particle's world, by its camera (7,)."""
        room = np.zeros((int((rows >= len(self.place)).sum()), 3))
        self.place, self._seen_from = (np.concatenate([one, room]) for one in (self.place, self._seen_from))
        self.place[rows], self._seen_from[rows] = place, SE3.translation(world_from_camera)

    def move(self, rows: np.ndarray, place: np.ndarray) -> None:
        """Moves landmarks (k,) to their positions (k, 3) in the corrected map, with unchanged viewing distances."""
        self._seen_from[rows] += place - self.place[rows]
        self.place[rows] = place

    def remove(self, rows: np.ndarray) -> None:
        for name in self.kept:
            setattr(self, name, np.delete(getattr(self, name), rows, axis=0))

    def in_view(self, world_from_camera: np.ndarray, std_direction_rad: float = 0.0) -> np.ndarray:
        """Landmarks that a camera (7,) of uncertain direction may observe and recognise, ascending."""
        camera = self.rig.camera
        margin = self.config.margin_px + min(SIGMAS * camera.fx * std_direction_rad, 0.5 * camera.width)
        # In or near both images; most are far outside.
        local = SE3.inverse_transform(world_from_camera, self.place)
        across = (max(camera.cx, camera.width - camera.cx) + margin) / camera.fx
        down = (max(camera.cy, camera.height - camera.cy) + margin) / camera.fy
        x, y, z = local.T
        rows = np.flatnonzero((z > 0.0) & (np.abs(x) <= across * z) & (np.abs(y) <= down * z))
        rows = rows[self.rig.visible(local[rows], -margin)]
        then = self.place[rows] - self._seen_from[rows]
        now = self.place[rows] - SE3.translation(world_from_camera)
        lengths = np.linalg.norm(then, axis=1), np.linalg.norm(now, axis=1)
        cosine = (then * now).sum(axis=1) / np.maximum(lengths[0] * lengths[1], 1e-300)
        ratio = np.abs(np.log(lengths[1] / np.maximum(lengths[0], 1e-300)))
        alike = cosine >= np.cos(np.deg2rad(self.config.max_turn_deg))
        return np.asarray(rows[alike & (ratio <= np.log(self.config.max_scale_change))])


def places_of(belief: Belief, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (k, 3) of landmarks (k,) in the heaviest particle, and covariances (k, 3, 3); none may be put away."""
    held, place, cov = belief.map.holds(ids), np.empty((ids.size, 3)), np.zeros((ids.size, 3, 3))
    if held.any():
        records = belief.read_mode(ids[held])
        place[held], cov[held] = records.mean[0], records.cov[0]
    if isinstance(belief.map, JointMap) and not held.all():
        world = dict(zip(*(each.tolist() for each in belief.map.old.places()), strict=True))
        frame = belief.map.world(SE3.identity((1,)), np.array([belief.mode]))
        place[~held] = SE3.inverse_transform(frame, np.array([world[name] for name in ids[~held].tolist()]))
    return place, cov


def make_room(held: Map, landmarks: np.ndarray, unseen_for: np.ndarray) -> None:
    """Puts the longest unobserved landmarks (M,) of a full joint map away, by `unseen_for` (M,) pairs; none of this pair."""
    if isinstance(held, JointMap) and held.is_full:
        unseen_for = np.where(held.holds(landmarks) & ~np.isin(landmarks, held.leaving), unseen_for, 0)
        order = np.argsort(-unseen_for, kind="stable")
        held.make_room(landmarks[order[: np.count_nonzero(unseen_for)]])
