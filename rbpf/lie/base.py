"""The interface of a state space, and the operations derived from it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.arrays import Array, Float, Like
from rbpf.errors import InputError

States = Like[ArrayLike, "*#batch {self.size}"]  #: Elements (..., E), as arguments.
Tangents = Like[ArrayLike, "*#batch {self.dim}"]  #: Tangent vectors (..., d), as arguments.
#: Results: (..., E), (..., d) and (..., d, d).
StateArray = Float[np.ndarray, "*batch {self.size}"]
TangentArray = Float[np.ndarray, "*batch {self.dim}"]
TangentMatrix = Float[np.ndarray, "*batch {self.dim} {self.dim}"]


def join(parts: Sequence[Array]) -> Array:
    """Concatenation along the last axis; the leading axes broadcast."""
    batch = parts[0].shape[:-1]
    if any(part.shape[:-1] != batch for part in parts):
        batch = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        parts = [np.broadcast_to(part, (*batch, part.shape[-1])) for part in parts]
    return np.concatenate(parts, axis=-1)


def of_rows(function: Callable[[Array, Array], None], x: ArrayLike, size: int, out_shape: tuple[int, ...]) -> Array:
    """Applies a function of rows, (..., size) -> (..., *out_shape)."""
    x = np.asarray(x, dtype=float)
    _require_size(x, size)
    out = np.empty((x.size // size, *out_shape))
    function(np.ascontiguousarray(x).reshape(-1, size), out)
    return out.reshape(*x.shape[:-1], *out_shape)


def of_pairs(
    function: Callable[[Array, Array, Array], None], x: ArrayLike, y: ArrayLike, sizes: tuple[int, int, int]
) -> Array:
    """Applies a function of the rows of two arrays that broadcast; `sizes`: lengths of their rows and of the result's."""
    x, y, (own, other, result) = np.asarray(x, dtype=float), np.asarray(y, dtype=float), sizes
    _require_size(x, own)
    _require_size(y, other)
    shape = x.shape[:-1]
    if x.ndim == 1:
        shape = y.shape[:-1]
    elif y.ndim > 1 and y.shape[:-1] != shape:
        shape = np.broadcast_shapes(shape, y.shape[:-1])
        x, y = _spread(x, shape), _spread(y, shape)
    out = np.empty((*shape, result))
    left, right = np.ascontiguousarray(x).reshape(-1, own), np.ascontiguousarray(y).reshape(-1, other)
    function(left, right, out.reshape(-1, result))
    return out


def _spread(x: Array, shape: tuple[int, ...]) -> Array:
    """Broadcasts to the leading axes `shape`; a single row stays one, as the kernels repeat it."""
    if x.size == x.shape[-1]:
        return x
    out = np.empty((*shape, x.shape[-1]))  # like np.broadcast_to, which takes as long as a kernel
    out[...] = x
    return out


def _require_size(x: Array, size: int) -> None:
    if x.ndim == 0 or x.shape[-1] != size:
        raise InputError(f"expected an array (..., {size}), got {x.shape}")


class LieGroup(ABC):
    """A space of states with a smooth group operation, and a vector chart xi -> x Exp(xi) around every point x."""

    size: int  #: Numbers stored per state, E.
    dim: int  #: Dimension of the tangent space, d.
    mean_rule: ClassVar = 50, 1e-14  #: Of `mean`: maximum number of iterations, and step size at convergence.

    @abstractmethod
    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape {self.size}"]:
        """Origin of the space, (*shape, E)."""

    @abstractmethod
    def normalise(self, x: States) -> StateArray:
        """Nearest valid storage: unit quaternion, wrapped angle."""

    @final
    def interpolate(self, a: States, b: States, s: Like[ArrayLike, "*#batch"]) -> StateArray:
        """Point at the fraction s of the geodesic from a, at 0, to b, at 1; s may lie outside [0, 1]."""
        return self.retract(a, np.asarray(s, dtype=float)[..., None] * self.local(a, b))

    @final
    def mean(
        self, x: Like[ArrayLike, "N {self.size}"], weights: Like[ArrayLike, " N"]
    ) -> Float[np.ndarray, " {self.size}"]:
        """Weighted Fréchet mean: the m with sum_i w_i local(m, x_i) = 0, of points (N, E) whose weights (N,) sum to one.

        Gauss-Newton from the heaviest point; for a `Finite` part the most probable value. The mean is unique if the points
        lie within a quarter turn of one another; for a wider cloud it is the stationary point next to the heaviest point.
        The sum runs in the order of the rows, so that results are reproducible to the byte.
        """
        points, weights = np.asarray(x, dtype=float), np.asarray(weights, dtype=float)
        return self._mean_from(self._first_guess(points, weights), points, weights)

    def _mean_from(self, mean: Array, points: Array, weights: Array) -> Array:
        """The stationary point next to an initial guess; a group may fuse the iteration."""
        iterations, tolerance = self.mean_rule
        for _ in range(iterations):
            step = (weights[:, None] * self.local(mean, points)).sum(0)
            mean = self.retract(mean, step)
            if np.abs(step).max(initial=0.0) <= tolerance:
                break
        return mean

    def _first_guess(self, points: Array, weights: Array) -> Array:
        """Initial guess of the mean: the heaviest point."""
        return points[np.argmax(weights)]

    @abstractmethod
    def exp(self, xi: Tangents) -> StateArray:
        """Exponential map, (..., d) -> (..., E)."""

    @abstractmethod
    def log(self, x: States) -> TangentArray:
        """Logarithm, (..., E) -> (..., d), with the rotation angle in [0, pi]."""

    @abstractmethod
    def compose(self, a: States, b: States) -> StateArray:
        """Group product a b, (..., E) and (..., E) -> (..., E)."""

    @abstractmethod
    def inverse(self, a: States) -> StateArray:
        """Group inverse, (..., E) -> (..., E)."""

    @abstractmethod
    def adjoint(self, a: States) -> TangentMatrix:
        """Ad_a with a Exp(xi) = Exp(Ad_a xi) a, (..., E) -> (..., d, d)."""

    @abstractmethod
    def left_jacobian(self, xi: Tangents) -> TangentMatrix:
        """J_l with Exp(xi + delta) = Exp(J_l delta) Exp(xi) to first order, (..., d) -> (..., d, d)."""

    @abstractmethod
    def left_jacobian_inverse(self, xi: Tangents) -> TangentMatrix:
        """Inverse of `left_jacobian`, (..., d) -> (..., d, d); singular at an angle of 2 pi."""

    @final
    def right_jacobian(self, xi: Tangents) -> TangentMatrix:
        """J_r with Exp(xi + delta) = Exp(xi) Exp(J_r delta) to first order, (..., d) -> (..., d, d)."""
        return self.left_jacobian(-np.asarray(xi, dtype=float))

    @final
    def right_jacobian_inverse(self, xi: Tangents) -> TangentMatrix:
        """Inverse of `right_jacobian`, (..., d) -> (..., d, d); singular at an angle of 2 pi."""
        return self.left_jacobian_inverse(-np.asarray(xi, dtype=float))

    @final
    def between(self, a: States, b: States) -> StateArray:
        """Product a^-1 b, (..., E) and (..., E) -> (..., E)."""
        return self.compose(self.inverse(a), b)

    def retract(self, x: States, xi: Tangents) -> StateArray:
        """Point x Exp(xi); a group may fuse the two steps for speed."""
        return self.compose(x, self.exp(xi))

    def local(self, x: States, y: States) -> TangentArray:
        """Coordinates Log(x^-1 y) of y in the chart at x, the inverse of `retract`; may be fused likewise."""
        return self.log(self.between(x, y))
