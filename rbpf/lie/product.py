"""The vector space R^n, finite sets, and direct products of Lie groups."""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from rbpf.arrays import Array, Float, Like
from rbpf.errors import InputError
from rbpf.lie.base import LieGroup, StateArray, States, TangentArray, TangentMatrix, Tangents, join


class Commutative(LieGroup):
    """A group with a b = b a: its adjoint and Jacobians are identities."""

    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape {self.size}"]:
        return np.zeros((*shape, self.size))

    def adjoint(self, a: States) -> TangentMatrix:
        return np.broadcast_to(np.eye(self.dim), (*np.shape(a)[:-1], self.dim, self.dim)).copy()

    def left_jacobian(self, xi: Tangents) -> TangentMatrix:
        return np.broadcast_to(np.eye(self.dim), (*np.shape(xi)[:-1], self.dim, self.dim)).copy()

    left_jacobian_inverse = left_jacobian


@final
class Euclidean(Commutative):
    """The vector space R^n, n >= 0; storage and tangent are the vector itself."""

    def __init__(self, n: int) -> None:
        if n < 0:
            raise InputError(f"Euclidean(n) needs n >= 0, got n = {n}.")
        self.size = self.dim = n

    def __repr__(self) -> str:
        return f"Euclidean({self.dim})"

    def exp(self, xi: Tangents) -> StateArray:
        return np.array(xi, dtype=float)

    def log(self, x: States) -> TangentArray:
        return np.array(x, dtype=float)

    normalise = log

    def compose(self, a: States, b: States) -> StateArray:
        return np.asarray(a, dtype=float) + np.asarray(b, dtype=float)

    def inverse(self, a: States) -> StateArray:
        return -np.asarray(a, dtype=float)

    def retract(self, x: States, xi: Tangents) -> StateArray:
        return self.compose(x, xi)

    def local(self, x: States, y: States) -> TangentArray:
        return np.asarray(y, dtype=float) - np.asarray(x, dtype=float)

    rotation = Commutative.adjoint  #: I (…, D, D).
    #: World points of body points, and their inverse: the group is that of translations.
    transform, inverse_transform = compose, local

    def transform_jacobian(self, p: States) -> TangentMatrix:
        """∂(Exp(ε) p)/∂ε (…, D, d) at ε = 0: I."""
        return np.broadcast_to(np.eye(self.dim), (*np.shape(p), self.dim))


@final
class Finite(Commutative):
    """The numbers 0, …, n − 1, such as a mode: a group under addition modulo n, without a tangent space.

    Discrete states move only by `MotionModel.sample`; their mean is the most probable value.
    """

    def __init__(self, n: int) -> None:
        if n < 1:
            raise InputError(f"Finite(n) needs n >= 1, got n = {n}.")
        self.n = n
        self.size, self.dim = 1, 0

    def __repr__(self) -> str:
        return f"Finite({self.n})"

    def probabilities(self, x: States, weights: Like[ArrayLike, " N"]) -> Float[np.ndarray, " {self.n}"]:
        """Probability of each value (n,), from particles (N, 1) and their weights (N,)."""
        return np.bincount(np.asarray(x)[:, 0].astype(np.int64), np.asarray(weights, dtype=float), self.n)

    def _first_guess(self, points: Array, weights: Array) -> Array:
        return np.array([float(np.argmax(self.probabilities(points, weights)))])

    def exp(self, xi: Tangents) -> StateArray:
        return np.zeros((*np.shape(xi)[:-1], 1))

    def log(self, x: States) -> TangentArray:
        return np.zeros((*np.shape(x)[:-1], 0))

    def compose(self, a: States, b: States) -> StateArray:
        return (np.asarray(a, dtype=float) + np.asarray(b, dtype=float)) % self.n

    def inverse(self, a: States) -> StateArray:
        return -np.asarray(a, dtype=float) % self.n

    def normalise(self, x: States) -> StateArray:
        return np.round(np.asarray(x, dtype=float)) % self.n


@final
class Product(LieGroup):
    """G_1 x G_2 x ...: storages and tangents follow one another in the order of the factors."""

    def __init__(self, *groups: LieGroup) -> None:
        if not groups:
            raise InputError("Product(*groups) needs at least one group, got none.")
        self.groups = groups  #: The factors, at least one.
        self.size = sum(group.size for group in groups)
        self.dim = sum(group.dim for group in groups)
        self._storage = _slices([group.size for group in groups])
        self._tangent = _slices([group.dim for group in groups])

    def __repr__(self) -> str:
        return f"Product({', '.join(map(repr, self.groups))})"

    def split(self, x: States) -> list[Array]:
        """Views of the factors' storages: (..., E) -> one (..., E_i) per factor."""
        array = np.asarray(x, dtype=float)
        return [array[..., part] for part in self._storage]

    def split_tangent(self, xi: Tangents) -> list[Array]:
        """Views of the factors' tangents: (..., d) -> one (..., d_i) per factor."""
        array = np.asarray(xi, dtype=float)
        return [array[..., part] for part in self._tangent]

    def join(self, parts: Sequence[ArrayLike]) -> Array:
        """One array from storages or tangents of all factors; their leading axes broadcast."""
        return join([np.asarray(part, dtype=float) for part in parts])

    def identity(self, shape: tuple[int, ...] = ()) -> Float[np.ndarray, "*shape {self.size}"]:
        return join([group.identity(shape) for group in self.groups])

    def _each(self, name: str, *arrays: list[Array]) -> Array:
        """Applies the factors' methods of this name to their parts, and joins the results."""
        return join([getattr(group, name)(*parts) for group, *parts in zip(self.groups, *arrays, strict=True)])

    def _first_guess(self, points: Array, weights: Array) -> Array:
        parts = zip(self.groups, self.split(points), strict=True)
        return join([group._first_guess(part, weights) for group, part in parts])

    def exp(self, xi: Tangents) -> StateArray:
        return self._each("exp", self.split_tangent(xi))

    def log(self, x: States) -> TangentArray:
        return self._each("log", self.split(x))

    def compose(self, a: States, b: States) -> StateArray:
        return self._each("compose", self.split(a), self.split(b))

    def inverse(self, a: States) -> StateArray:
        return self._each("inverse", self.split(a))

    def retract(self, x: States, xi: Tangents) -> StateArray:
        return self._each("retract", self.split(x), self.split_tangent(xi))

    def local(self, x: States, y: States) -> TangentArray:
        return self._each("local", self.split(x), self.split(y))

    def normalise(self, x: States) -> StateArray:
        return self._each("normalise", self.split(x))

    def adjoint(self, a: States) -> TangentMatrix:
        return self._blocks("adjoint", self.split(a))

    def left_jacobian(self, xi: Tangents) -> TangentMatrix:
        return self._blocks("left_jacobian", self.split_tangent(xi))

    def left_jacobian_inverse(self, xi: Tangents) -> TangentMatrix:
        return self._blocks("left_jacobian_inverse", self.split_tangent(xi))

    def _blocks(self, name: str, parts: list[Array]) -> Array:
        """Block-diagonal matrices (…, d, d) of the results of the factors' methods of this name."""
        out = np.zeros((*parts[0].shape[:-1], self.dim, self.dim))
        for rows, group, part in zip(self._tangent, self.groups, parts, strict=True):
            out[..., rows, rows] = getattr(group, name)(part)
        return out


def _slices(lengths: list[int]) -> list[slice]:
    return [slice(start, stop) for start, stop in pairwise(accumulate(lengths, initial=0))]
