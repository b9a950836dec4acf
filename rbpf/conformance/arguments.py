"""What a model is tried on."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rbpf.conformance.calls import FindingError, called
from rbpf.core.models import Landmark, ObservationModel, Part, Records
from rbpf.errors import InputError
from rbpf.lie import LieGroup, SE2Group, SE3Group

PARTICLES, LANDMARKS = 5, 4
CANDIDATES = 400
"""Random landmarks per particle, of which the first visible ones are taken."""
SPREAD = 5.0
"""Standard deviation of random landmarks, in their own units."""


@dataclass(frozen=True)
class Example:
    """What to try a model on, where random draws make no sense; all of it is optional.

    Attributes:
        state: (N, E) states.
        landmark: the parametrisation that an observation model reads; by default a point.
        records: (N, K, …) estimates of landmarks.
        substate: m, size of the linear substate that an observation model reads.
        control: what a motion model moves by.
        dt: seconds.
        frame: what a sensor observes.
        belief: what it knows before; its map may be changed by the check.
    """

    state: np.ndarray | None = None
    landmark: Landmark | None = None
    records: Records | None = None
    substate: int = 0
    control: Any = None
    dt: float = 0.1
    frame: Any = None
    belief: Any = None

    def states(self, space: LieGroup, rng: np.random.Generator) -> np.ndarray:
        """(N, E), drawn around the origin where none are given."""
        if self.state is not None:
            return self.state
        return space.retract(space.identity((PARTICLES,)), rng.normal(size=(PARTICLES, space.dim)))


@dataclass(frozen=True)
class Scene:
    """Arguments of an observation model.

    Attributes:
        space: group of the state.
        state: (N, 1, E).
        landmark: (N, K, D).
        const: (N, K, A), the landmarks' constants.
        substate: (N, 1, m).
    """

    space: LieGroup
    state: np.ndarray
    landmark: np.ndarray | None = None
    const: np.ndarray | None = None
    substate: np.ndarray | None = None

    @classmethod
    def draw(
        cls, model: ObservationModel, space: LieGroup, rng: np.random.Generator, example: Example
    ) -> "Scene":
        """Random states and, around the origin, landmarks that are visible from them.

        Raises:
            InputError: the size of the substate is not known, or too few random landmarks are visible.
        """
        scene = cls(space, example.states(space, rng)[:, None, :])
        if Part.SUBSTATE in model.reads:
            if example.substate < 1:
                raise InputError(f"{type(model).__name__} reads a substate: give Example(substate=its size)")
            scene = replace(scene, substate=rng.normal(size=(scene.state.shape[0], 1, example.substate)))
        if Part.LANDMARK not in model.reads:
            return scene
        if example.records is not None:
            return replace(scene, landmark=example.records.mean, const=example.records.const)
        return scene._with_landmarks(model, rng, example.landmark)

    @property
    def args(self) -> tuple[Any, ...]:
        """In the order of `ObservationModel.predict`."""
        return self.state, self.landmark, self.const, self.substate

    @property
    def batch(self) -> tuple[int, ...]:
        """Leading axes of a prediction."""
        return np.broadcast_shapes(*(part.shape[:-1] for part in self.args if part is not None))

    def one(self, i: int, k: int) -> "Scene":
        """Particle i and landmark k, without leading axes."""
        return self._mapped(lambda part: part[i, min(k, part.shape[1] - 1)])

    def moved(self, shape: tuple[int, ...], part: Part) -> "Scene":
        """The same with more axes in front of one part."""

        def more(array: np.ndarray) -> np.ndarray:
            return np.broadcast_to(array, (*shape, *array.shape))

        if part is Part.STATE:
            return replace(self, state=more(self.state))
        if part is Part.LANDMARK:
            return replace(self, landmark=None if self.landmark is None else more(self.landmark))
        return replace(self, substate=None if self.substate is None else more(self.substate))

    def lanes(self) -> "Scene":
        """All pairs of a particle and a landmark side by side, (N·K, …)."""
        batch = self.batch

        def flat(part: np.ndarray) -> np.ndarray:
            return np.broadcast_to(part, (*batch, part.shape[-1])).reshape(-1, part.shape[-1])

        return self._mapped(flat)

    def _mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Scene":
        state, *others = (None if part is None else function(part) for part in self.args)
        assert state is not None
        return Scene(self.space, state, *others)

    def _with_landmarks(
        self, model: ObservationModel, rng: np.random.Generator, landmark: Landmark | None
    ) -> "Scene":
        dim = _landmark_dim(model, self, rng) if landmark is None else landmark.dim
        mean = SPREAD * rng.normal(size=(self.state.shape[0], CANDIDATES, dim))
        const = None if landmark is None else random_constants(landmark, self.space, rng, mean.shape[:2])
        try:
            seen = np.broadcast_to(called(model.visible, self.state, mean, const), mean.shape[:2])
        except (FindingError, ValueError):
            seen = np.ones(mean.shape[:2], dtype=bool)
        chosen = np.argsort(seen == 0, axis=1, kind="stable")[:, :LANDMARKS]
        if not np.take_along_axis(seen, chosen, axis=1).all():
            what = f"{type(model).__name__} sees too few random landmarks"
            raise InputError(f"{what}: give Example(state=…, records=…) that it can see")
        const = None if const is None else np.take_along_axis(const, chosen[..., None], axis=1)
        return replace(self, landmark=np.take_along_axis(mean, chosen[..., None], axis=1), const=const)


def random_constants(
    landmark: Landmark, space: LieGroup | None, rng: np.random.Generator, shape: tuple[int, ...]
) -> np.ndarray | None:
    """(*shape, A): elements of the group where they have its size, as anchor poses do; else normal."""
    if landmark.constants == 0:
        return None
    if space is None or space.size != landmark.constants:
        return rng.normal(size=(*shape, landmark.constants))
    return space.retract(space.identity(shape), rng.normal(size=(*shape, space.dim)))


def _landmark_dim(model: ObservationModel, scene: Scene, rng: np.random.Generator) -> int:
    """The dimension of a point that the model can predict: that of the space first, else the lowest."""
    known = {SE2Group: 2, SE3Group: 3}.get(type(scene.space), scene.space.dim)
    for dim in (known, 1, 2, 3, 4, 5, 6):
        trial = replace(scene, landmark=SPREAD * rng.normal(size=(scene.state.shape[0], LANDMARKS, dim)))
        try:
            predicted = model.predict(*trial.args)
        except Exception:
            continue
        if np.shape(predicted) == (*trial.batch, model.dim):
            return dim
    return known
