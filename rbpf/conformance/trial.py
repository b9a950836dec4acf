"""Test arguments for a user's model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator

from rbpf.core.models import Belief, Landmark, ObservationModel, Observations, Part, Records, Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup, Product, SE2Group, SE3Group

PARTICLES, LANDMARKS = 5, 4
CANDIDATES = 400  #: Random landmarks per particle, of which the first visible ones are used.
SPREAD = 5.0  #: Standard deviation of random landmarks, in their own units.


@dataclass(frozen=True)
class Example:
    """Arguments for checking a model, where random draws make no sense; all are optional."""

    state: np.ndarray | None = None  #: (N, E) states.
    landmark: Landmark | None = None  #: the parametrisation that an observation model reads; by default a point.
    records: Records | None = None  #: (N, K, …) estimates of landmarks.
    substate: int = 0  #: m, size of the linear substate that an observation model reads.
    control: object = None  #: control input of a motion model.
    dt: float = 0.1  #: seconds.
    frame: object = None  #: input of a sensor.
    belief: Belief | None = None  #: its prior belief; the check may change its map.
    groups: Sequence[Observations] = ()  #: observations for a conditional.
    transition: Transition | None = None  #: of the states, for a conditional that drives the motion.

    def states(self, space: LieGroup, rng: Generator) -> np.ndarray:
        """(N, E), drawn around the origin where none are given."""
        if self.state is not None:
            return self.state
        return space.retract(space.identity((PARTICLES,)), rng.normal(size=(PARTICLES, space.dim)))


@dataclass(frozen=True)
class Scene:
    """Arguments of an observation model: state (N, 1, E), landmark (N, K, D), const (N, K, A), substate (N, 1, m)."""

    space: LieGroup
    state: np.ndarray
    landmark: np.ndarray | None = None
    const: np.ndarray | None = None
    substate: np.ndarray | None = None

    @classmethod
    def draw(cls, model: ObservationModel, space: LieGroup, rng: Generator, example: Example) -> "Scene":
        """Random states and, around the origin, landmarks that are visible from them. Raises InputError: too few are."""
        scene = cls(space, example.states(space, rng)[:, None, :])
        if Part.SUBSTATE in model.reads:
            if example.substate < 1:
                raise InputError(f"{type(model).__name__} reads a substate: give Example(substate=its size)")
            scene = replace(scene, substate=rng.normal(size=(scene.state.shape[0], 1, example.substate)))
        if Part.LANDMARK not in model.reads:
            return scene
        if example.records is not None:
            return replace(scene, landmark=example.records.mean, const=example.records.const)
        landmark, n = example.landmark, scene.state.shape[0]
        dim = scene._landmark_dim(model, rng) if landmark is None else landmark.dim
        mean = SPREAD * rng.normal(size=(n, CANDIDATES, dim))
        const = None if landmark is None else random_constants(landmark, space, rng, mean.shape[:2])
        try:
            seen = np.broadcast_to(model.visible(scene.state, mean.copy(), const), mean.shape[:2])
        except Exception:  # which is a finding of its own
            seen = np.ones(mean.shape[:2], dtype=bool)
        chosen = np.argsort(seen == 0, axis=1, kind="stable")[:, :LANDMARKS]
        if not np.take_along_axis(seen, chosen, axis=1).all():
            what = f"{type(model).__name__} sees too few random landmarks"
            raise InputError(f"{what}: give Example(state=…, records=…) that it can see")
        const = None if const is None else np.take_along_axis(const, chosen[..., None], axis=1)
        return replace(scene, landmark=np.take_along_axis(mean, chosen[..., None], axis=1), const=const)

    @property
    def args(self) -> tuple[Any, ...]:
        return self.state, self.landmark, self.const, self.substate

    @property
    def batch(self) -> tuple[int, ...]:
        """Leading axes of a prediction."""
        return np.broadcast_shapes(*(part.shape[:-1] for part in self.args if part is not None))

    def moved(self, shape: tuple[int, ...], part: Part) -> "Scene":
        """The same with more axes in front of one part."""
        name = {Part.STATE: "state", Part.LANDMARK: "landmark"}.get(part, "substate")
        array = getattr(self, name)
        more: dict[str, Any] = {} if array is None else {name: np.broadcast_to(array, (*shape, *array.shape))}
        return replace(self, **more)

    def lanes(self) -> "Scene":
        """All pairs of a particle and a landmark side by side, (N·K, …)."""
        batch = self.batch

        def flat(part: np.ndarray) -> np.ndarray:
            return np.broadcast_to(part, (*batch, part.shape[-1])).reshape(-1, part.shape[-1])

        return self.mapped(flat)

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Scene":
        """A function of every part."""
        state, *others = (None if part is None else function(part) for part in self.args)
        assert state is not None
        return Scene(self.space, state, *others)

    def _landmark_dim(self, model: ObservationModel, rng: Generator) -> int:
        """The dimension of a point that the model can predict: that of the space first, else the lowest."""
        first = self.space.groups[0] if isinstance(self.space, Product) else self.space
        known = {SE2Group: 2, SE3Group: 3}.get(type(first), self.space.dim)
        for dim in (known, 1, 2, 3, 4, 5, 6):
            trial = replace(self, landmark=SPREAD * rng.normal(size=(self.state.shape[0], LANDMARKS, dim)))
            try:
                predicted = model.predict(*trial.args)
            except Exception:
                continue
            if np.shape(predicted) == (*trial.batch, model.dim):
                return dim
        return known


def random_constants(
    landmark: Landmark, space: LieGroup | None, rng: Generator, shape: tuple[int, ...]
) -> np.ndarray | None:
    """(*shape, A): elements of the group where they have its size, as anchor poses do; else normal."""
    if landmark.constants == 0:
        return None
    if space is None or space.size != landmark.constants:
        return rng.normal(size=(*shape, landmark.constants))
    return space.retract(space.identity(shape), rng.normal(size=(*shape, space.dim)))
