"""Ranges of settings and options, declared at the field and checked when the object is created.

    @dataclass(frozen=True)
    class Config(Ranged):
        noise_px: Positive = 1.0
        cells: Annotated[int, Range(ge=1, le=1000)] = 6

Every number has a range: by default it must be finite and at most `LARGEST` in magnitude.
"""

import math
import numbers
import os
from dataclasses import dataclass, field, fields
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from rbpf.errors import InputError

#: Default limit of numbers: larger ones are mistakes, and their squares could overflow.
LARGEST = 1e9
MOST = 10**7  #: Limit of particles, landmarks or images: more than any machine holds.


@dataclass(frozen=True)
class Range:
    """The range of a number: at least `ge`, above `gt`, at most `le`, below `lt`, and odd if so declared."""

    ge: float = -LARGEST
    gt: float = -math.inf
    le: float = LARGEST
    lt: float = math.inf
    odd: bool = False

    def holds(self, value: float) -> bool:
        """Whether a number is in the range; NaN is not."""
        inside = self.ge <= value <= self.le and self.gt < value < self.lt
        return inside and (not self.odd or value % 2 == 1)

    def words(self) -> str:
        low = f"above {self.gt:.12g}" if self.gt >= self.ge else f"at least {self.ge:.12g}"
        high = f" and below {self.lt:.12g}" if self.lt <= self.le else f" and at most {self.le:.12g}"
        return f"{'odd, ' if self.odd else ''}{low}{'' if math.isinf(self.le) else high}"


@dataclass(frozen=True)
class Formerly:
    """Former name of a field: `load_settings` refuses it and names the current one."""

    name: str = field(repr=False)  # hidden from the annotation, where Sphinx would take it for a reference


ANY = Range()
Positive = Annotated[float, Range(gt=0.0)]
NotNegative = Annotated[float, Range(ge=0.0)]
Fraction = Annotated[float, Range(ge=0.0, le=1.0)]
Rate = Annotated[float, Range(ge=0.0, lt=1.0)]
Probability = Annotated[float, Range(gt=0.0, lt=1.0)]
Ratio = Annotated[float, Range(ge=1.0)]  #: Ratio of the larger to the smaller.
Angle = Annotated[float, Range(ge=0.0, le=180.0)]  #: Degrees.
Count = Annotated[int, Range(ge=1, le=MOST)]
CountOrNone = Annotated[int, Range(ge=0, le=MOST)]
Seed = Annotated[int, Range(ge=0, le=2**63 - 1)]


class Ranged:
    """A dataclass whose fields are validated by their declarations."""

    def __post_init__(self) -> None:
        check_ranges(self)


class SettingError(InputError):
    """A field has an invalid value; `words` describe the expected and the actual value."""

    def __init__(self, name: str, words: str, whose: str = "") -> None:
        super().__init__(f"{whose}{name} {words}")
        self.name, self.words = name, words


def check_ranges(settings: Any, whose: str = "") -> None:
    """Raises SettingError: a field has another type than declared, or a number is out of its range.

    `whose` precedes the field's name in the message, such as "the camera's ".
    """
    kind: Any = type(settings)
    for name, hint in _hints(kind).items():
        value = getattr(settings, name)
        expected = _expected(hint, value, ANY)
        if expected is not None:
            raise SettingError(name, f"must be {expected}, got {value!r}", whose)


def require_memory(size: float, what: str) -> None:
    """Raises InputError: more bytes are needed than the machine has; `what` names their purpose."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > memory:
        raise InputError(
            f"{what} would take {size / 1e9:.1f} GB of memory, this machine has {memory / 1e9:.1f} GB: take fewer particles"
        )


def former_names(kind: Any) -> dict[str, str]:
    """Former names of a dataclass's fields, with the current ones."""
    notes = {name: getattr(hint, "__metadata__", ()) for name, hint in _hints(kind).items()}
    return {note.name: name for name, of_field in notes.items() for note in of_field if isinstance(note, Formerly)}


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind) if field.name in hints}


def _expected(hint: Any, value: Any, allowed: Range) -> str | None:
    """Description of the expected value; None if the value is valid, or the type is unknown."""
    if get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        allowed = next((note for note in notes if isinstance(note, Range)), allowed)
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        found = [_expected(kind, value, allowed) for kind in get_args(hint)]
        words = [each for each in found if each is not None]
        return None if len(words) < len(found) else words[0]
    if origin is Literal:
        choices = get_args(hint)
        return None if any(value == choice for choice in choices) else " or ".join(map(repr, choices))
    if origin is tuple and isinstance(value, tuple):
        kinds = [kind for kind in get_args(hint) if kind is not Ellipsis]
        found = [_expected(kinds[min(k, len(kinds) - 1)], each, allowed) for k, each in enumerate(value)]
        return next((f"numbers, each {words}" for words in found if words is not None), None)
    if hint is NoneType:
        return None if value is None else "none"
    if hint is bool:
        # Also NumPy's, which is not imported.
        boolean = isinstance(value, bool) or str(getattr(value, "dtype", "")) == "bool"
        return None if boolean else "true or false"
    if hint in (int, float):
        # This includes NumPy's numbers.
        fits = isinstance(value, numbers.Integral if hint is int else numbers.Real) and not isinstance(value, bool)
        what = "a whole number, " if hint is int else ""
        return None if fits and allowed.holds(value) else f"{what}{allowed.words()}"
    return None
