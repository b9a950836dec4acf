"""R^n with addition."""

from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.arrays import Float, Like
from rbpf.errors import InputError
from rbpf.lie.base import Array, LieGroup


@final
class Euclidean(LieGroup):
    """The vector space R^n; storage and tangent are the vector itself."""

    def __init__(self, n: int) -> None:
        """Space of n dimensions.

        Args:
            n: Dimension, at least 0.

        Raises:
            InputError: n is negative.
        """
        if n < 0:
            raise InputError(f"Euclidean(n) needs n >= 0, got n = {n}.")
        self.size = self.dim = n

    def __repr__(self) -> str:
        return f"Euclidean({self.dim})"

    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape {self.size}"]:
        return np.zeros((*shape, self.size))

    def exp(self, xi: Like[ArrayLike, "*#batch {self.dim}"]) -> Float[np.ndarray, "*batch {self.size}"]:
        return np.array(xi, dtype=float)

    def log(self, x: Like[ArrayLike, "*#batch {self.size}"]) -> Float[np.ndarray, "*batch {self.dim}"]:
        return np.array(x, dtype=float)

    def compose(
        self, a: Like[ArrayLike, "*#batch {self.size}"], b: Like[ArrayLike, "*#batch {self.size}"]
    ) -> Float[np.ndarray, "*batch {self.size}"]:
        return np.asarray(a, dtype=float) + np.asarray(b, dtype=float)

    def inverse(self, a: Like[ArrayLike, "*#batch {self.size}"]) -> Float[np.ndarray, "*batch {self.size}"]:
        return -np.asarray(a, dtype=float)

    def retract(
        self, x: Like[ArrayLike, "*#batch {self.size}"], xi: Like[ArrayLike, "*#batch {self.dim}"]
    ) -> Float[np.ndarray, "*batch {self.size}"]:
        return self.compose(x, xi)

    def local(
        self, x: Like[ArrayLike, "*#batch {self.size}"], y: Like[ArrayLike, "*#batch {self.size}"]
    ) -> Float[np.ndarray, "*batch {self.dim}"]:
        return np.asarray(y, dtype=float) - np.asarray(x, dtype=float)

    def normalise(self, x: Like[ArrayLike, "*#batch {self.size}"]) -> Float[np.ndarray, "*batch {self.size}"]:
        return np.array(x, dtype=float)

    def adjoint(
        self, a: Like[ArrayLike, "*#batch {self.size}"]
    ) -> Float[np.ndarray, "*batch {self.dim} {self.dim}"]:
        return self._unit_matrices(np.shape(a)[:-1])

    def left_jacobian(
        self, xi: Like[ArrayLike, "*#batch {self.dim}"]
    ) -> Float[np.ndarray, "*batch {self.dim} {self.dim}"]:
        return self._unit_matrices(np.shape(xi)[:-1])

    def left_jacobian_inverse(
        self, xi: Like[ArrayLike, "*#batch {self.dim}"]
    ) -> Float[np.ndarray, "*batch {self.dim} {self.dim}"]:
        return self._unit_matrices(np.shape(xi)[:-1])

    def _unit_matrices(self, shape: tuple[int, ...]) -> Array:
        return np.broadcast_to(np.eye(self.dim), (*shape, self.dim, self.dim)).copy()
