"""Points that a simulated camera's user knows beforehand."""

from dataclasses import dataclass

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld, PointWorld, Scene

EXACT = Measuring(dropout=0.0, turnover=0.0)


@dataclass(frozen=True)
class Line:
    """A camera at rest that sees points on a line."""

    points: int = 10

    def build(self, rng: np.random.Generator) -> Scene:
        points = np.zeros((self.points, 3))
        points[:, 0] = rng.uniform(-1.0, 1.0, self.points)
        points[:, 2] = 3.0
        still = SE3.identity((2,))
        present = np.tile([0, 2], (self.points, 1))
        return Scene("line", np.arange(2), still, points, present, np.zeros((0, 2, 3)))


def test_known_points_are_measured_whenever_they_are_visible() -> None:
    log = simulate_features(DeskWorld(frames=1000, blocks=0), EXACT, MONO, seed=2)
    assert log.known is not None and log.truth is not None
    points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
    local = SE3.inverse_transform(log.truth.world_from_camera[:, None], points)
    visible = MONO.visible(local, margin_px=13.0)
    measured = np.array([np.isin(log.known.names, frame.landmarks) for frame in log.frames])
    assert visible[0].all() and not visible.all()
    np.testing.assert_array_equal(measured, visible)


def test_known_points_are_given_with_the_stated_error() -> None:
    score, flat = [], []
    for seed in range(20):
        log = simulate_features(DeskWorld(frames=2), Measuring(known=5, known_std_m=0.02), MONO, seed)
        assert log.known is not None and log.truth is not None
        points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
        score.append((log.known.positions - points) / 0.02)
        np.testing.assert_allclose(log.known.cov, np.tile(4e-4 * np.eye(3), (5, 1, 1)))
        px = MONO.project(SE3.inverse_transform(log.truth.world_from_camera[0], points))
        flat.append(np.linalg.svd(px - px.mean(axis=0), compute_uv=False)[1])
    n = np.size(score)
    assert abs(np.sum(np.square(score)) - n) < 4.0 * np.sqrt(2.0 * n)
    assert min(flat) > 100.0


def test_exactly_known_points() -> None:
    log = simulate_features(DeskWorld(frames=2), Measuring(known_std_m=0.0), MONO, seed=0)
    assert log.known is not None and log.truth is not None
    points = np.array([log.truth.landmarks[name] for name in log.known.names.tolist()])
    np.testing.assert_array_equal(log.known.positions, points)
    assert not log.known.cov.any()


@pytest.mark.parametrize(
    ("world", "measuring", "message"),
    [
        (
            DeskWorld(points=3),
            Measuring(),
            "first frame of the desk sees [0-3] points .* expected 4: simulate more",
        ),
        (DeskWorld(), Measuring(known=30), "30 known points do not fit into 25 measurements"),
        (Line(), Measuring(known=3), "known points of the line lie on a line in the first frame"),
    ],
)
def test_refused_worlds(world: PointWorld, measuring: Measuring, message: str) -> None:
    with pytest.raises(InputError, match=message):
        simulate_features(world, measuring, MONO, seed=0)


def test_two_known_points_cannot_be_on_a_line() -> None:
    log = simulate_features(Line(), Measuring(known=2), MONO, seed=0)
    assert log.known is not None and len(log.known.names) == 2
