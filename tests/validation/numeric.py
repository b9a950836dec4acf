"""Numeric derivatives and robust weights that the tests of batch optimisers compare with."""

from collections.abc import Callable, Iterable

import numpy as np


def slope_of(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """∂function/∂x (m, n) by central differences, of a function (…, n) → (…, m) of many places at once."""
    moves = step * np.eye(len(x))
    return ((function(x + moves) - function(x - moves)) / (2 * step)).T


def shrunk(whitened: np.ndarray, robust: float | None) -> np.ndarray:
    """Residuals (…, p) of which half the square is Huber's loss with this bound; None leaves them."""
    if robust is None:
        return whitened
    norm = np.linalg.norm(whitened, axis=-1, keepdims=True)
    beyond = np.maximum(norm, robust)
    return whitened * np.sqrt(robust * (2 * beyond - robust)) / beyond


def assert_same_covariances(found: Iterable[np.ndarray], expected: Iterable[np.ndarray], tolerance: float) -> None:
    """One by one, each up to a fraction of its largest entry."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance * np.abs(other).max())
