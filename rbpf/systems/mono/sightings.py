"""What a run looked for in each frame, kept small, so that pictures can be drawn after it and cost it no time."""

from dataclasses import dataclass, fields
from typing import final

import numpy as np

from rbpf.core.anchoring import Anchored
from rbpf.core.belief import Belief
from rbpf.core.filter import Filter
from rbpf.sensors.catalogue_index import NameIndex
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.systems.mono.feature_sensor import FeatureSensor
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.viewing import directions

_SIGMAS = 3.0
"""An epipolar line is kept between the inverse depths that lie this far from the mean."""


@dataclass(frozen=True)
class Sighting:
    """One frame: K features that were looked for, and J that were started.

    Attributes:
        rows: (K,) of the sensor's table.
        mean: (K, 2) predicted places, px.
        cov: (K, 2, 2) with the noise of the measurement, px².
        px: (K, 2) where each was found; NaN where not.
        line: (K, 2, 2) ends of the epipolar line of a ray, px; NaN for points.
        place: (K, 4) homogeneous point in the reported world; NaN where it was not found.
        started: (J, 2) where features were started, px.
        held: (1, 2) landmarks in the map after the frame: points and rays.
    """

    rows: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    px: np.ndarray
    line: np.ndarray
    place: np.ndarray
    started: np.ndarray
    held: np.ndarray

    @property
    def found(self) -> np.ndarray:
        """(K,) whether each was found."""
        return np.isfinite(self.px).all(axis=1)

    @property
    def is_ray(self) -> np.ndarray:
        """(K,) whether its depth was still unknown after the frame."""
        return np.isfinite(self.line).all(axis=(1, 2))


@final
class Sightings:
    """The sightings of all frames so far.

    Args:
        given: rows of the sensor's table that were there before the first frame, and are not told as started in it.
    """

    def __init__(self, given: int = 0) -> None:
        self.frames: list[Sighting] = []
        self._names = NameIndex()
        self._given = self._started = given

    def record(self, sensor: ImageSensor, filter_: Filter, world: Anchored | None) -> None:
        """Takes note of the sensor's last frame, once the filter has made its step.

        Args:
            sensor: of the run.
            filter_: after the step.
            world: the world that poses are told in, in each particle's own; None where they are one.
        """
        searched, belief = sensor.searched, filter_.belief()
        px = np.where(searched.found[:, None], searched.px, np.nan)
        place = _in_reported_world(sensor.table.place[searched.rows], world, belief.mode)
        place[~searched.found] = np.nan
        line = self._lines(sensor.features, belief, searched.rows)
        started = sensor.table.first_px[self._started :].copy()
        self._started = sensor.table.count
        rays = int(belief.map.are(belief.map.ids, sensor.features.inverse_depth).sum())
        held = np.array([[belief.map.ids.size - rays, rays]])
        self.frames.append(
            Sighting(searched.rows, searched.mean, searched.cov, px, line, place, started, held)
        )

    def measured(self, stamps_ns: np.ndarray, found: np.ndarray, noise_px: float) -> list[FeatureFrame]:
        """What the filter used in each frame, and what started features; names are rows of the sensor's table.

        Of a frame in which too little agreed to be trusted nothing was used, and nothing is told.

        Args:
            stamps_ns: (T,) of the frames.
            found: (T,) number of features that were used.
            noise_px: standard deviation of a place, per axis.
        """
        out, count = [], self._given
        for stamp, used, frame in zip(stamps_ns.tolist(), found.tolist(), self.frames, strict=True):
            kept = frame.found & bool(used)
            started = np.arange(count, count + frame.started.shape[0])
            count += started.size
            names = np.concatenate([frame.rows[kept], started])
            cov = np.tile(noise_px**2 * np.eye(2), (names.size, 1, 1))
            out.append(FeatureFrame(stamp, names, np.concatenate([frame.px[kept], frame.started]), cov))
        return out

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        out = {}
        for item in fields(Sighting):
            parts = [getattr(frame, item.name) for frame in self.frames]
            out[f"sightings/{item.name}"] = np.concatenate(parts)
        out["sightings/counts"] = np.array([[f.rows.size, f.started.shape[0]] for f in self.frames])
        return out

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        looked_for, started = np.cumsum(arrays["sightings/counts"], axis=0)[:-1].T
        cuts = {"started": started, "held": np.arange(1, looked_for.size + 1)}
        columns = [
            np.split(arrays[f"sightings/{item.name}"], cuts.get(item.name, looked_for))
            for item in fields(Sighting)
        ]
        self.frames = [Sighting(*parts) for parts in zip(*columns, strict=True)]
        self._started = self._given + sum(frame.started.shape[0] for frame in self.frames)

    def _lines(self, features: FeatureSensor, belief: Belief, rows: np.ndarray) -> np.ndarray:
        """Ends (K, 2, 2) of the epipolar lines of those features that are rays, in the heaviest particle."""
        line = np.full((rows.size, 2, 2), np.nan)
        known = self._names.ids(belief.catalogue)
        ids = np.array([known.get(row, -1) for row in rows.tolist()], dtype=np.int64)
        held = np.flatnonzero(ids >= 0)
        rays = held[belief.map.are(ids[held], features.inverse_depth)]
        if rays.size:
            ends = ray_ends(features, belief, ids[rays], _SIGMAS)
            seen = directions(ends.reshape(-1, 4), belief.state[belief.mode][:7])
            px = features.camera.project(seen)
            px[~(seen[:, 2] > 0.0)] = np.nan
            line[rays] = px.reshape(-1, 2, 2)
        return line


def ray_ends(features: FeatureSensor, belief: Belief, ids: np.ndarray, sigmas: float) -> np.ndarray:
    """Nearest and farthest point (K, 2, 4) on rays in the heaviest particle, homogeneous, so many σ of ρ apart."""
    records = belief.read_mode(ids)
    assert records.const is not None
    mean = records.mean[0][:, None].repeat(2, axis=1)
    spread = sigmas * np.sqrt(records.cov[0][:, 2, 2])
    mean[:, 0, 2] += spread
    mean[:, 1, 2] = np.maximum(mean[:, 1, 2] - spread, 0.0)
    return features.inverse_depth.homogeneous(mean, records.const[0][:, None])


def _in_reported_world(place: np.ndarray, world: Anchored | None, mode: int) -> np.ndarray:
    """Homogeneous points (K, 4) of the heaviest particle's world in the world that poses are told in."""
    if world is None:
        return place.copy()
    return np.concatenate([directions(place, world.mean[mode]), place[:, 3:]], axis=1)
