"""Calling a user's method and judging what comes back."""

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from typing import Any

import numpy as np

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


def called(method: Callable[..., Any], *args: Any, repeat: bool = True) -> Any:
    """What a method returns, after it was seen to return the same twice and to leave its arguments alone."""
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
    fits = any(
        len(shape) == array.ndim and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        for shape in allowed
    )
    expected = " or ".join(str(shape).replace("None", "any") for shape in allowed)
    require(fits, f"{what} has shape {array.shape}, expected {expected}")
    require(np.isfinite(array).all(), f"{what} holds NaN or infinity, expected finite numbers")


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
    """The numeric arrays inside a result."""
    if isinstance(value, np.ndarray):
        return [value] if value.dtype.kind in "fiub" else []
    if is_dataclass(value):
        value = tuple(vars(value).values())
    if isinstance(value, tuple | list):
        return [array for item in value for array in _arrays_in(item)]
    return []
