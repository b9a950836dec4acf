"""Occupancy grids: what beams write, what particles share, and the likelihood field, each beside plain NumPy."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import norm

from rbpf.core.filter import Filter
from rbpf.core.models import Observations, Proposal
from rbpf.core.particles import Prior
from rbpf.core.proposals import PriorProposal
from rbpf.core.resampling import EssTriggered, Multinomial
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.grid import GRID, GridConfig, GridMap
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.laser import BeamSensor
from rbpf.systems.laser.slam import ScanMatching

COARSE = GridConfig(cell_m=0.25, sigma_m=0.3)


def room(n: int = 60, weight: float = 0.3) -> np.ndarray:
    """Beams (n, 5) from the middle of a room of 5 m by 3.4 m, seen all round."""
    angle = np.linspace(-np.pi, np.pi, n, endpoint=False)
    reach = np.minimum(2.5 / np.maximum(abs(np.cos(angle)), 1e-9), 1.7 / np.maximum(abs(np.sin(angle)), 1e-9))
    ends = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.column_stack([np.zeros((n, 2)), ends, np.full(n, weight)])


def begun(config: GridConfig, n: int) -> GridMap:
    grid = GridMap(config)
    Filter(OdometryMotion(SE2), BeamSensor(GRID), grid, n=n)
    return grid


def ends_of(state: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return SE2.transform(state, beams[:, :2]), SE2.transform(state, beams[:, 2:4])


def crossed(start: np.ndarray, end: np.ndarray, side: float) -> set[tuple[int, int]]:
    """Cells (x, y) whose inside a segment meets: by where it enters and leaves each square of its bounding box."""
    low, high = np.floor(np.minimum(start, end) / side), np.floor(np.maximum(start, end) / side)
    found = set()
    for cell in product(*(range(int(a), int(b) + 1) for a, b in zip(low, high, strict=True))):
        with np.errstate(divide="ignore", invalid="ignore"):
            at = (np.stack([np.array(cell), np.array(cell) + 1]) * side - start) / (end - start)
        entry, exit_ = np.nanmax([at.min(axis=0).max(), 0.0]), np.nanmin([at.max(axis=0).min(), 1.0])
        if exit_ - entry > 1e-12:
            found.add(cell)
    return found


def written(states: list[np.ndarray], beams: np.ndarray, config: GridConfig) -> dict[tuple[int, int], np.ndarray]:
    """Log-odds, count and mean place of the cells that scans leave, cell by cell."""
    cells: dict[tuple[int, int], np.ndarray] = {}
    for state in states:
        starts, ends = ends_of(state, beams)
        last = [tuple(np.floor(end / config.cell_m).astype(int).tolist()) for end in ends]
        for start, end, own in zip(starts, ends, last, strict=True):
            for cell in crossed(start, end, config.cell_m) - {own}:
                at = cells.setdefault(cell, np.zeros(4))
                at[0] = max(at[0] - config.miss, -config.bound)
        for end, own in zip(ends, last, strict=True):
            at = cells.setdefault(own, np.zeros(4))
            at[0] = min(at[0] + config.hit, config.bound)
            at[1] += 1.0
            at[2:] += (end / config.cell_m - own - at[2:]) / at[1]
    return cells


def field(cells: dict[tuple[int, int], np.ndarray], points: np.ndarray, config: GridConfig) -> np.ndarray:
    """log(1 + ρ exp(−d²/2σ²)) at points (K, 2), between the centres of the four cells about each."""
    walls = np.array([(np.array(cell) + at[2:]) * config.cell_m for cell, at in cells.items() if at[0] > 0.0])
    corner = np.floor(points / config.cell_m - 0.5)
    total = np.zeros(len(points))
    for shift in product((0, 1), (0, 1)):
        centre = (corner + shift + 0.5) * config.cell_m
        share = np.prod(1.0 - abs(points - centre) / config.cell_m, axis=1)
        nearest = np.linalg.norm(centre[:, None] - walls, axis=2).min(axis=1)
        total += share * np.log1p(config.hit_ratio * np.exp(-0.5 * (nearest / config.sigma_m) ** 2))
    return total


def log_odds_of(grid: GridMap, particle: int) -> dict[tuple[int, int], float]:
    picture = grid.picture(particle)
    corner = np.round(picture.corner / picture.cell_m).astype(int)
    rows = np.argwhere(picture.log_odds != 0.0)
    return {(int(x + corner[0]), int(y + corner[1])): float(picture.log_odds[y, x]) for y, x in rows}


@pytest.mark.parametrize("state", [(0.0, 0.05, 0.1), (0.7, -3.31, 40.2), (-2.0, 7.77, -8.13)])
def test_a_scan_writes_the_cells_that_its_beams_meet(state):
    grid, beams, states = begun(COARSE, 2), room(), np.array([state, state])
    states[1] += [0.1, 0.3, -0.2]
    for _ in range(2):
        grid.insert(states, beams)
    for particle in range(2):
        expected = written([states[particle]] * 2, beams, COARSE)
        found = log_odds_of(grid, particle)
        assert found.keys() == {cell for cell, at in expected.items() if at[0] != 0.0}
        np.testing.assert_allclose([found[c] for c in found], [expected[c][0] for c in found], rtol=1e-5)


def test_log_odds_are_bayes_posterior_of_cells_that_are_seen_independently():
    """Two cells, each free or occupied, prior 1/2; readings right with the probabilities of `hit` and `miss`."""
    grid = begun(replace(COARSE, bound=9.0), 1)
    near, far = np.array([[0.1, 0.1, 0.4, 0.1, 1.0]]), np.array([[0.1, 0.1, 0.6, 0.1, 1.0]])
    readings = [near, far, far, near, far]
    for beam in readings:
        grid.insert(np.zeros((1, 3)), beam)
    p = {False: 1.0 / (1.0 + np.exp(COARSE.hit)), True: 1.0 / (1.0 + np.exp(-COARSE.hit))}
    q = {False: 1.0 / (1.0 + np.exp(-COARSE.miss)), True: 1.0 / (1.0 + np.exp(COARSE.miss))}
    weight = {}
    for first, second in product((False, True), (False, True)):
        likely = 1.0
        for beam in readings:
            likely *= p[first] if beam is near else q[first] * p[second]
        weight[first, second] = likely
    found = log_odds_of(grid, 0)
    odds = (weight[True, False] + weight[True, True]) / (weight[False, False] + weight[False, True])
    np.testing.assert_allclose(found[1, 0], np.log(odds), rtol=1e-5)
    odds = (weight[False, True] + weight[True, True]) / (weight[False, False] + weight[True, False])
    np.testing.assert_allclose(found[2, 0], np.log(odds), rtol=1e-5)


def test_tiles_are_shared_until_they_are_written():
    grid, beams, states = begun(GridConfig(), 3), room(), np.diag([0.1, 0.2, 0.3])
    grid.insert(states, beams)
    separate, before = grid.tiles, [grid.picture(i).log_odds.copy() for i in range(3)]
    grid.resample(np.array([1, 1, 1]))
    shared = grid.tiles
    assert shared == (grid.index[1] >= 0).sum() < 0.4 * separate
    for particle in range(3):
        np.testing.assert_array_equal(grid.picture(particle).log_odds, before[1])
    # One scan in a corner of the room: only the tile that it meets is copied, and nobody else sees it.
    corner = np.array([[0.0, 0.0, 0.3, 0.2, 1.0]])
    grid.resample(np.array([0, 1, 2]))
    grid.insert(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), corner)
    assert grid.tiles == shared + 2  # of the three that share the tile, two copy it, and one is left with it
    changed = [np.argwhere(grid.picture(i).log_odds != before[1]) for i in range(3)]
    np.testing.assert_array_equal(changed[0], changed[1])
    assert changed[2].size and not {*map(tuple, changed[0])} & {*map(tuple, changed[2])}
    # Who has no descendants gives its tiles back, and they are used again.
    pool = len(grid.pool)
    for _ in range(30):
        grid.resample(np.array([0, 0, 0]))
        grid.insert(states, beams)
    assert len(grid.pool) == pool


def test_the_score_of_a_scan_is_the_field_of_the_nearest_walls():
    """Up to how finely a wall's place in its cell is tabulated, an eighth of a cell."""
    config, beams, rng = GridConfig(), room(20), np.random.default_rng(0)
    states = np.array([[0.02, 0.03, -0.04], [-0.05, 0.1, 0.02]])
    grid = begun(config, 2)
    grid.insert(states, beams)
    seen = states + rng.normal(size=(2, 3)) * 0.05
    found = grid.log_likelihood(seen, beams)
    for particle in range(2):
        cells = written([states[particle]], beams, config)
        expected = beams[:, 4] * field(cells, ends_of(seen[particle], beams)[1], config)
        assert abs(found[particle] - expected.sum()) < 0.03 * expected.sum()
    assert found.min() > 0.3 * beams[:, 4].sum() * np.log1p(config.hit_ratio)


@pytest.mark.parametrize("off", [(0.3, 0.4, -0.3), (-0.35, -0.2, 0.45)])
def test_a_search_finds_a_pose_that_no_gradient_leads_to(off):
    """Half a metre and 20° away, where most beams end beyond the field of the wall that they belong to."""
    beams, grid = room(120), begun(GridConfig(), 2)
    grid.insert(np.zeros((2, 3)), beams)
    start = SE2.retract(np.zeros((2, 3)), np.array(off))
    std = np.array([0.2, 0.2, 0.2])
    proposed, fit = grid.match(Prior(SE2, start, np.zeros((1, 3)), np.diag(std)[None]), beams)
    assert abs(SE2.retract(start, proposed.mean * std)).max() < 0.02 and fit.min() > 0.9


def test_weights_and_posterior_are_those_of_the_integral_over_the_pose():
    """∫ p(z|x) p(x|x⁻) dx and the posterior's mean by a lattice over x, for both proposals: the weights are exact."""
    config, beams = GridConfig(sigma_m=0.1), room(40, 0.15)
    std, off = np.array([0.05, 0.08, 0.06]), np.array([0.03, 0.06, -0.04])
    # The lattice.
    at = np.linspace(-4.5, 4.5, 19)
    u = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = begun(config, 1)
    grid.insert(np.zeros((1, 3)), beams)
    proposed, _ = grid.match(Prior(SE2, off[None], np.zeros((1, 3)), np.diag(std)[None]), beams)
    grid.resample(np.zeros(len(u), dtype=np.int64))
    log_p = grid.log_likelihood(SE2.retract(off, u * std), beams) + norm.logpdf(u).sum(axis=1)
    p = np.exp(log_p - log_p.max())
    log_integral = np.log(p.sum()) + log_p.max() + 3 * np.log(at[1] - at[0])
    mean = (p[:, None] * u).sum(axis=0) / p.sum()

    def filtered(proposal: type[Proposal], n: int) -> tuple[float, np.ndarray]:
        own = GridMap(config)
        never = EssTriggered(Multinomial(), 0.0)
        filter_ = Filter(OdometryMotion(SE2), BeamSensor(GRID), own, None, never, n, np.random.default_rng(5))
        filter_.step(beams, None, 0, PriorProposal())
        moved = Odometry(off, np.diag(std**2))
        made = ScanMatching(own, beams) if proposal is ScanMatching else PriorProposal()
        before = filter_.particles.log_weights.copy()
        report = filter_.step(beams, moved, 1, made)
        assert np.isnan(report.log_evidence) and np.ptp(before) < 1e-12  # a weighted product is no density
        weights = filter_.particles.weights
        increments = SE2.local(np.broadcast_to(off, (n, 3)), filter_.particles.state) / std
        return float(1.0 / np.square(weights).sum() / n), weights @ increments

    for kind, n in ((ScanMatching, 200), (PriorProposal, 1000)):
        fraction, found = filtered(kind, n)
        np.testing.assert_allclose(found, mean, atol=4.0 / np.sqrt(n * fraction))
        assert fraction > (0.4 if kind is ScanMatching else 0.02)
    # The look-ahead weight is Laplace's integral.
    np.testing.assert_allclose(proposed.log_w1[0], log_integral, atol=0.2)


def test_the_map_grows_as_far_as_the_memory_reaches():
    grid, beams = begun(GridConfig(), 1), room()
    grid.insert(np.zeros((1, 3)), beams)
    near = log_odds_of(grid, 0)
    grid.insert(np.array([[0.0, -300.0, 170.0]]), beams)
    assert near.items() <= log_odds_of(grid, 0).items()
    with pytest.raises(InputError, match=r"a map of \d+ m by 1000\d+ m would take"):
        grid.insert(np.array([[0.0, 1e9, 0.0]]), beams)


@pytest.mark.parametrize("data", [np.zeros((3, 4)), np.full((2, 5), np.nan), "scan"])
def test_what_is_no_scan_is_refused(data):
    with pytest.raises(InputError, match="scan"):
        begun(COARSE, 1).correct(np.zeros((1, 3)), np.zeros((1, 3)), [Observations.raw(data, GRID)])
