"""Occupancy grids in the plane, one per particle, in tiles that particles share and copy on write.

Each cell holds the log-odds that it is occupied (H. Moravec and A. Elfes 1985), given the particle's path, and the mean
position of the beams that ended in it, which is finer than the cell. A scan's likelihood is the likelihood field of S. Thrun,
W. Burgard, D. Fox 2005, §6.4, by the distance of each beam's end from the nearest obstacle.

    log p(z | x, m) = Σ_k w_k log(1 + ρ exp(−d_k² / 2σ²)) + const

with the distance d_k from the end of beam k to the nearest occupied cell's mean position, and the ratio ρ of a hit's density
at d = 0 to that of an end anywhere. The weights w_k ≤ 1 are the sensor's: neighbouring beams are not independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, final

import numba
import numpy as np

from rbpf.arrays import numbers as numbers_of
from rbpf.core.checkpoint import integers, numbers, read
from rbpf.core.genealogy import Lineage
from rbpf.core.models import Conditional, LogDensities, Observations, Part
from rbpf.core.particles import Prior, Proposed
from rbpf.errors import InputError
from rbpf.maps import grid_kernels as cells
from rbpf.ranges import Positive, Range, Ranged, require_memory

_FIRST_TILES = 256
_EVERY = 2  #: The lattice search uses every such beam,
_APART = 16  #: in an order that starts with every such one of these.
GRID = Part("occupancy grid")  #: Name of the grid in a filter.


@dataclass(frozen=True)
class GridConfig(Ranged):
    """Settings of the cells and of the likelihood field."""

    cell_m: Annotated[float, Range(ge=0.005, le=1.0)] = 0.05  #: side of a cell.
    hit: Positive = 0.85  #: added to the log-odds of a cell in which a beam ends; p = 0.7.
    miss: Positive = 0.4  #: subtracted where one passes; p = 0.4.
    bound: Positive = 4.0  #: of the log-odds, so that removed objects are forgotten.
    #: σ of a beam's end about an obstacle: noise of the scanner and the map, and the cell size.
    sigma_m: Positive = 0.05
    hit_ratio: Positive = 20.0  #: ρ, likelihood ratio of an end at an obstacle to one anywhere.


@dataclass(frozen=True)
class Picture:
    """One particle's grid: log-odds (H, W), row 0 at the lowest y, 0 for unknown; and its corner [m]."""

    log_odds: np.ndarray
    cell_m: float
    corner: np.ndarray  #: (2,) x and y of the outer corner of cell [0, 0].

    def walls(self) -> np.ndarray:
        """(M, 2) centres of the occupied cells, m."""
        return self.corner + self.cell_m * (np.argwhere(self.log_odds > 0.0)[:, ::-1] + 0.5)


@final
class GridMap(Conditional):
    """Grids, given the sampled states in SE(2). Raw data of the part `GRID` are beams (K, 5), see `rbpf.maps.grid_kernels`."""

    supplies, takes_raw = GRID, True

    def __init__(self, config: GridConfig | None = None) -> None:
        self.config = config or GridConfig()
        side, sigma = self.config.cell_m, self.config.sigma_m
        # Range up to which a hit is at least a twentieth as likely as an end anywhere.
        half = int(np.ceil(sigma * np.sqrt(2.0 * np.log(20.0 * max(self.config.hit_ratio, 1.0))) / side))
        # Values at nearby cell centres of an occupied cell with mean position ((i + ½)/8, (j + ½)/8).
        place = (np.arange(cells.FINE) + 0.5) / cells.FINE - 0.5
        square = ((np.arange(-half, half + 1) - place[:, None]) * side) ** 2
        distance = square[:, None, :, None] + square[None, :, None, :]
        stamps = np.log1p(self.config.hit_ratio * np.exp(-0.5 * distance / sigma**2))
        self._stamps = stamps.astype(np.float32)
        self._marks, self._fields = np.zeros((0, 0, 0), dtype=bool), np.zeros((0, 0, 0), dtype=np.float32)
        self._change = np.array([self.config.hit, self.config.miss, self.config.bound])
        # Steps for differences of the field, wider than single cells: one σ, and the angle of one σ at four metres.
        self._steps = np.array([sigma / 4.0, sigma, sigma]) / 2.0

    def begin(self, n: int, lineage: Lineage) -> None:
        tile = cells.TILE
        self.index = np.full((n, 1, 1), -1, dtype=np.int32)
        self.origin = np.zeros(2, dtype=np.int64)
        self.pool = np.zeros((_FIRST_TILES, cells.PLANES, tile, tile), dtype=np.float32)
        self.users = np.zeros(_FIRST_TILES, dtype=np.int64)

    @property
    def tiles(self) -> int:
        """Number of tiles in use."""
        return int(np.count_nonzero(self.users))

    def match(self, prior: Prior, beams: np.ndarray, most: int = 20_000) -> tuple[Proposed, np.ndarray]:
        """Scan matching: the Gaussian at the increment that maximises prior times likelihood of a scan (K, 5), and its fit.

        Its covariance is from the prior and the field's curvature there; its look-ahead weight is Laplace's integral. The
        lattice of the search spans three standard deviations of the prior; with more than `most` points its spacing is
        increased. The fit (N,) is the log-likelihood relative to that of a scan whose beams all end exactly at obstacles.

        Raises InputError: the prior's increment has a nonzero mean, as for a motion driven by a substate.
        """
        if not prior.centred:
            raise InputError("scan matching needs an increment of mean zero, not one driven by a substate")
        n = prior.base.shape[0]
        cov = (prior.factor @ np.swapaxes(prior.factor, -1, -2)).mean(axis=0)
        radius = 3.0 * np.sqrt(np.diag(cov)) + 1e-9
        reach = max(1.0, float(np.sqrt(np.square(beams[:, 2:4]).sum(axis=1).mean())) if beams.size else 0.0)
        step = self.config.sigma_m
        spacing = 2.0 * np.array([step / reach, step, step])
        points = float(np.prod(2.0 * np.ceil(radius / spacing) + 1.0))
        spacing *= max(1.0, (points / most) ** (1.0 / 3.0))
        slack = float(np.hypot(radius[1], radius[2])) + float(spacing[1])
        info = np.linalg.inv(cov + 1e-12 * np.eye(3))
        found, value, hessian = np.empty((n, 3)), np.empty(n), np.empty((n, 3, 3))
        place = self._place(prior.base, beams, slack)
        # Neighbouring beams are redundant: distant ones come first, with the most that the rest of the scan can add.
        few = beams[::_EVERY] * [1.0, 1.0, 1.0, 1.0, _EVERY]
        few = few[np.argsort(np.arange(len(few)) % _APART, kind="stable")]
        rest = np.ascontiguousarray(few[::-1, 4].cumsum()[::-1]) * float(self._stamps.max())
        lattice = info, radius, spacing, self._steps, few, rest
        cells.search(len(self._fields), *place, *lattice, found, value, hessian)
        factor = np.broadcast_to(prior.factor, (n, *prior.factor.shape[1:]))
        # Negative curvature at the maximum, as information; scaled so that the steps have equal weight.
        unit = self._steps
        curve, axes = np.linalg.eigh(-hessian * unit[:, None] * unit)
        scaled = axes / unit[:, None]
        falling = (scaled * np.maximum(curve, 0.0)[:, None, :]) @ np.swapaxes(scaled, -1, -2)
        curvature = np.swapaxes(factor, -1, -2) @ falling @ factor
        root = np.linalg.cholesky(np.eye(factor.shape[2]) + curvature)
        u = (np.linalg.pinv(factor) @ found[..., None])[..., 0]
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        log_w1 = value - 0.5 * (u * u).sum(axis=1) - log_det
        fit = value / max(float(beams[:, 4].sum()) * np.log1p(self.config.hit_ratio), 1e-9)
        # The field has no innovation with a χ²-distributed square.
        unknown = np.full(n, np.nan)
        return Proposed(u, np.swapaxes(np.linalg.inv(root), -1, -2), log_w1, unknown, np.zeros(n)), fit

    def log_likelihood(self, state: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """(N,) log p(z | x, m) up to a constant, of a scan (K, 5) at the states (N, 3)."""
        value = np.empty(state.shape[0])
        place = self._place(state, beams)
        cells.scores(len(self._fields), *place, value)
        return value

    def correct(self, state: np.ndarray, increment: np.ndarray, groups: Sequence[Observations]) -> LogDensities:
        """The likelihood at the states; then the scan is inserted."""
        scans = [beams_of(group) for group in groups]
        total = sum((self.log_likelihood(state, beams) for beams in scans), np.zeros(state.shape[0]))
        for beams in scans:
            self.insert(state, beams)
        return LogDensities(total, np.zeros_like(total))

    def insert(self, state: np.ndarray, beams: np.ndarray) -> None:
        """Inserts a scan (K, 5) at the states (N, 3)."""
        if not beams.shape[0]:
            return
        self._cover(state, beams)
        touched = np.zeros(self.index.shape, dtype=bool)
        side = self.config.cell_m
        cells.touch(state, beams, side, self.origin, touched)
        # Upper bound of new tiles: those to be written that are shared or missing.
        count = int(np.count_nonzero(touched & ((self.index < 0) | (self.users[self.index] > 1))))
        lacking = count - int(np.count_nonzero(self.users == 0))
        if lacking > 0:
            more = max(lacking, self.users.size)
            total = self.users.size + more
            require_memory(4.0 * total * self.pool[0].size, f"{total} tiles of the map")
            held, self.pool = self.pool, np.zeros((total, *self.pool.shape[1:]), dtype=np.float32)
            self.pool[: len(held)] = held  # untouched memory is not allocated
            self.users = np.concatenate([self.users, np.zeros(more, dtype=np.int64)])
        cells.own(touched, self.index, self.users, self.pool, np.flatnonzero(self.users == 0))
        cells.insert(len(state), state, beams, side, self.origin, self.index, self.pool, self._change)

    def resample(self, ancestors: np.ndarray) -> None:
        self.index = np.ascontiguousarray(self.index[ancestors])
        used = self.index[self.index >= 0]
        self.users = np.bincount(used, minlength=self.users.size).astype(np.int64)

    def picture(self, particle: int) -> Picture:
        """The grid of one particle, cropped to the known area."""
        tile, index = cells.TILE, self.index[particle]
        held = np.argwhere(index >= 0)
        low, high = (held.min(axis=0), held.max(axis=0) + 1) if held.size else (np.zeros(2, int), np.ones(2, int))
        cut = index[low[0] : high[0], low[1] : high[1]]
        found = np.where((cut >= 0)[:, :, None, None], self.pool[cut, cells.LOG_ODDS], 0.0)
        height, width = cut.shape
        log_odds = found.transpose(0, 2, 1, 3).reshape(height * tile, width * tile)
        corner = (low + self.origin)[::-1] * (tile * self.config.cell_m)
        return Picture(log_odds, self.config.cell_m, corner)

    def arrays(self) -> dict[str, np.ndarray]:
        # In the order of the particles' indices, which is independent of their positions in the pool.
        tiles, first = np.unique(self.index[self.index >= 0], return_index=True)
        used = tiles[np.argsort(first)]
        number = np.full(self.users.size + 1, -1)
        number[used] = np.arange(used.size)
        return {"grid/index": number[self.index], "grid/origin": self.origin, "grid/cells": self.pool[used]}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        n, tile = self.index.shape[0], cells.TILE
        schema = {
            "cells": numbers("tiles", cells.PLANES, tile, tile),
            "index": integers(n, "height", "width", least=-1, below="tiles"),
            "origin": integers(2),
        }
        found = read(arrays, schema, "grid/")
        self.index, self.origin = found["index"].astype(np.int32), found["origin"]
        self.pool = found["cells"].astype(np.float32)
        self.users = np.bincount(self.index[self.index >= 0], minlength=len(self.pool)).astype(np.int64)

    def options(self) -> dict[str, object]:
        return {"grid": repr(self.config)}

    def _place(self, state: np.ndarray, beams: np.ndarray, slack: float = 0.0) -> tuple:
        """Arguments of the field's kernels; the window extends `slack` [m] beyond the beams."""
        side = self.config.cell_m
        reach = float(np.hypot(beams[:, 2], beams[:, 3]).max(initial=0.0)) + slack + self._stamps.shape[2] * side
        tiles = 2 * int(np.ceil(reach / (side * cells.TILE))) + 3
        threads = min(numba.get_num_threads(), state.shape[0])
        if self._marks.shape[0] != threads or self._marks.shape[1] < tiles:
            cells_wide = tiles * cells.TILE + self._stamps.shape[2] - 1
            require_memory(4.0 * threads * cells_wide**2, f"the likelihood field of a scan that reaches {reach:.0f} m")
            self._fields = np.zeros((threads, cells_wide, cells_wide), dtype=np.float32)
            self._marks = np.zeros((threads, tiles, tiles), dtype=bool)
        fields = self._fields, self._marks
        return (np.ascontiguousarray(state), beams, side, self.origin, self.index, self.pool, self._stamps, *fields)

    def _cover(self, state: np.ndarray, beams: np.ndarray) -> None:
        """Extends the index to cover the beams."""
        pitch = self.config.cell_m * cells.TILE
        reach = float(np.hypot(beams[:, [0, 2]], beams[:, [1, 3]]).max()) + pitch
        low = np.floor((state[:, :0:-1].min(axis=0) - reach) / pitch).astype(np.int64)
        high = np.floor((state[:, :0:-1].max(axis=0) + reach) / pitch).astype(np.int64) + 1
        if not (self.index >= 0).any():
            self.index, self.origin = self.index[:, :0, :0], low
        before, after = self.origin, self.origin + self.index.shape[1:]
        low, high = np.minimum(low, before), np.maximum(high, after)
        if (low == before).all() and (high == after).all():
            return
        height, width = (high - low).tolist()
        need = 4.0 * len(self.index) * height * width
        require_memory(need, f"a map of {height * pitch:.0f} m by {width * pitch:.0f} m")
        more = zip(before - low, high - after, strict=True)
        self.index, self.origin = np.pad(self.index, ((0, 0), *more), constant_values=-1), low


def beams_of(group: Observations) -> np.ndarray:
    """The beams (K, 5) of a group. Raises InputError: the data are of another type, or not finite."""
    beams = numbers_of(np.asarray(group.data), "a scan")
    if beams.ndim != 2 or beams.shape[1] != 5 or not np.isfinite(beams).all():
        raise InputError(f"a scan for a grid needs finite beams (K, 5): starts, ends, weights; got {beams.shape}")
    return beams
