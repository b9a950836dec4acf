"""What a user's model is tried on, how its methods are called, and how their answers are judged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator

from rbpf.core.models import Belief, Landmark, ObservationModel, Observations, Part, Records, Transition
from rbpf.errors import InputError
from rbpf.lie import LieGroup, Product, SE2Group, SE3Group

PARTICLES, LANDMARKS = 5, 4
CANDIDATES = 400  #: Random landmarks per particle, of which the first visible ones are taken.
SPREAD = 5.0  #: Standard deviation of random landmarks, in their own units.


@dataclass(frozen=True)
class Example:
    """What to try a model on, where random draws make no sense; all of it is optional."""

    state: np.ndarray | None = None  #: (N, E) states.
    landmark: Landmark | None = None  #: the parametrisation that an observation model reads; by default a point.
    records: Records | None = None  #: (N, K, …) estimates of landmarks.
    substate: int = 0  #: m, size of the linear substate that an observation model reads.
    control: object = None  #: what a motion model moves by.
    dt: float = 0.1  #: seconds.
    frame: object = None  #: what a sensor observes.
    belief: Belief | None = None  #: what it knows before; its map may be changed by the check.
    groups: Sequence[Observations] = ()  #: what a conditional is updated by.
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
            seen = np.broadcast_to(called(model.visible, scene.state, mean, const), mean.shape[:2])
        except (FindingError, ValueError):
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


Check = Callable[[], None]


class FindingError(Exception):
    """Ends a check; its text is the sentence that the user reads."""


def run(checks: Sequence[Check]) -> list[str]:
    """Sentences of the checks that fail; the others rest on the first one."""
    findings = []
    for number, check in enumerate(checks):
        try:
            check()
        except FindingError as finding:
            findings.append(str(finding))
            if number == 0:
                break
    return list(dict.fromkeys(findings))


def called(method: Callable[..., Any], *args: Any, repeat: bool = True, gives: Sequence[type] = ()) -> Any:
    """What a method returns, after it was seen to return the same twice and to leave its arguments alone.

    If types are given, it must be of one of these.
    """
    name, given = named(method), [np.copy(arg) for arg in args if isinstance(arg, np.ndarray)]
    try:
        first = method(*args)
        second = method(*args) if repeat else first
    except Exception as error:
        shapes = ", ".join(str(array.shape) for array in given)
        sentence = f"{name} raised {type(error).__name__} for arguments of shapes {shapes}: {error}"
        raise FindingError(sentence) from error
    now = [arg for arg in args if isinstance(arg, np.ndarray)]
    changed = any(not np.array_equal(a, b, equal_nan=True) for a, b in zip(given, now, strict=True))
    require(not changed, f"{name} changes its arguments in place: it must work on copies")
    pairs = zip(_arrays_in(first), _arrays_in(second), strict=False)
    alike = all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    require(alike, f"{name} returns different numbers for the same arguments: it must not draw or count")
    if gives:
        require_type(name, first, *gives)
    return first


def named(method: Callable[..., Any]) -> str:
    """Class and name of a bound method."""
    return f"{type(getattr(method, '__self__', None)).__name__}.{method.__name__}"


def require(holds: Any, sentence: str) -> None:
    """Ends the check with a sentence unless the condition holds."""
    if not holds:
        raise FindingError(sentence)


def require_type(what: str, value: Any, *allowed: type) -> None:
    """Of one of the allowed types."""
    expected = " or ".join("None" if kind is type(None) else kind.__name__ for kind in allowed)
    require(isinstance(value, allowed), f"{what} returned a {type(value).__name__}, expected {expected}")


def require_shape(what: str, array: Any, *allowed: tuple[int | None, ...]) -> None:
    """An array of one of the allowed shapes, None for any length, without NaN and infinity."""
    require(isinstance(array, np.ndarray), f"{what} is a {type(array).__name__}, expected a NumPy array")
    alike = [shape for shape in allowed if len(shape) == array.ndim]
    fits = any(all(a in (None, b) for a, b in zip(shape, array.shape, strict=True)) for shape in alike)
    expected = " or ".join(str(shape).replace("None", "any") for shape in allowed)
    require(fits, f"{what} has shape {array.shape}, expected {expected}")
    require(array.dtype.kind in "fiub", f"{what} holds {array.dtype}, expected real numbers")
    require(np.isfinite(array).all(), f"{what} holds NaN or infinity, expected finite numbers")


def require_truths(what: str, array: Any, *allowed: tuple[int | None, ...]) -> None:
    """Truth values of one of the allowed shapes."""
    require_shape(what, array, *allowed)
    require(array.dtype == bool, f"{what.split(' for ')[0]} returns {array.dtype}, expected bool")


def require_close(what: str, found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Equal to the tolerance, relative to 1 + |expected|; the sentence names the worst entry."""
    require(found.shape == expected.shape, f"{what}: expected shape {expected.shape}, found {found.shape}")
    error = np.abs(found - expected) / (1.0 + np.abs(expected))
    if not (error > tolerance).any():
        return
    place = tuple(int(i) for i in np.unravel_index(int(np.argmax(error)), error.shape))
    raise FindingError(f"{what}: expected {expected[place]:.9g}, found {found[place]:.9g} at {place}")


def require_covariance(what: str, cov: np.ndarray) -> None:
    """Symmetric and positive semi-definite."""
    skew, scale = np.abs(cov - np.swapaxes(cov, -1, -2)).max(initial=0.0), np.abs(cov).max(initial=0.0)
    require(skew <= 1e-9 * scale, f"{what} is not symmetric, entries differ by {skew:.3g}")
    lowest = float(np.linalg.eigvalsh(cov).min(initial=0.0))
    sentence = f"{what} is not positive semi-definite, its lowest eigenvalue is {lowest:.3g}"
    require(lowest >= -1e-9 * scale, sentence)


def _arrays_in(value: Any) -> list[np.ndarray]:
    if isinstance(value, np.ndarray):
        return [value] if value.dtype.kind in "fiub" else []
    if is_dataclass(value):
        value = tuple(vars(value).values())
    if isinstance(value, tuple | list):
        return [array for item in value for array in _arrays_in(item)]
    return []
