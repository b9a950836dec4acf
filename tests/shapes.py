"""The first calls of each function of the package in each test are checked against the shapes in its signature.

`watch` has to run before the package is imported. A call is checked after it has returned, so that bad input is refused
by the program's own sentence; for the same reason what a dataclass holds is checked where it is handed over, not where
it is made. `RBPF_SHAPES=0` switches it off: it costs some microseconds per argument.
"""

import inspect
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from functools import cache, wraps
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import FunctionType, ModuleType, SimpleNamespace, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
from jaxtyping import AbstractArray, Shaped, jaxtyped

MADE_BY = ("__init__", "__new__")

COMPILED = "rbpf.kernels"
"""Numba reads these functions itself."""


CALLS = 8
"""Of a function that are checked in each test: a filter of thousands of steps would take several times as long else."""

switch = SimpleNamespace(on=True, test=0)
"""Off in tests that hand over what is wrong on purpose: fixture `unchecked_shapes`; and the number of the test."""


class ShapeError(TypeError):
    """An array that does not have the shape or the kind of number that a signature says."""


def watch() -> None:
    """Checks whatever is imported from `rbpf` from now on."""
    imported = sorted(name for name in sys.modules if name == "rbpf" or name.startswith("rbpf."))
    if imported:
        raise RuntimeError(f"watch() must come before the package is imported, but {imported[0]} is there")
    sys.meta_path.insert(0, _Finder())


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, raising `ShapeError` where an argument or the result is not what its signature says."""
    hints = {name: hint for name, hint in function.__annotations__.items() if _has_shape(hint)}
    if not hints:
        return function
    names, test, calls, result = list(inspect.signature(function).parameters), -1, 0, None
    own, named = re.findall(r"{self\.(\w+)}", str(hints)), re.findall(r"{(\w+)}", str(hints))
    passed = set[Any]()

    @wraps(function)
    def some(*args: Any, **kwargs: Any) -> Any:
        nonlocal test, calls, result
        if calls == CALLS and test == switch.test:
            return function(*args, **kwargs)
        calls = 1 if test != switch.test else calls + 1
        test = switch.test
        given = function(*args, **kwargs)
        if switch.on:
            values = {**dict(zip(names, args, strict=False)), **kwargs, "return": given}
            seen = *(getattr(args[0], name) for name in own), *(values.get(name) for name in named)
            seen += tuple(outline(values.get(name, some)) for name in hints)
            if seen not in passed:
                result = given
                check(*args, **kwargs)
                passed.add(seen)
        return given

    @jaxtyped(typechecker=None)
    @wraps(function)
    def check(*args: Any, **kwargs: Any) -> None:
        values = {**dict(zip(names, args, strict=False)), **kwargs, "return": result}
        for name, hint in hints.items():
            if name in values and not fits(values[name], hint):
                given = f"{np.shape(values[name])} {getattr(values[name], 'dtype', type(values[name]))}"
                raise ShapeError(f"{function.__qualname__}: {name} is {given}, expected {hint}")

    return some


def outline(value: Any) -> Any:
    """All of a value that `fits` looks at: of two with one outline both fit, or none. Of a list this is itself alone."""
    kind = type(value)
    if isinstance(value, np.ndarray):
        return kind, value.shape, value.dtype
    if isinstance(value, tuple):
        return kind, *map(outline, value)
    names = {name for each in kind.__mro__ for name in _fields(each)} if is_dataclass(value) else ()
    return object() if isinstance(value, list) else (kind, *(outline(getattr(value, name)) for name in sorted(names)))


def fits(value: Any, hint: Any) -> bool:
    """Whether a value has the shape of an annotation; true where the annotation has none."""
    origin = get_origin(hint)
    if _is_like(hint):
        return isinstance(np.asarray(value), Shaped[np.ndarray, get_args(hint)[1]])
    if origin in (Union, UnionType):
        return value is None or any(fits(value, part) for part in get_args(hint) if part is not type(None))
    if origin is tuple:
        return all(fits(item, part) for item, part in zip(value, get_args(hint), strict=True))
    if _is_array(hint):
        return isinstance(np.asarray(value) if isinstance(value, np.generic) else value, hint)
    return not (inspect.isclass(hint) and isinstance(value, hint)) or _holds_what_it_says(value, hint)


def _holds_what_it_says(value: Any, kind: type) -> bool:
    """Whether the arrays of a dataclass or a named tuple agree with one another."""
    with jaxtyped("context"):
        return all(fits(getattr(value, name), hint) for name, hint in _fields(kind).items())


@cache
def _fields(kind: type) -> dict[str, Any]:
    """Annotations of a dataclass or a named tuple that have a shape."""
    if not (is_dataclass(kind) or issubclass(kind, tuple)):
        return {}
    return {name: hint for name, hint in inspect.get_annotations(kind).items() if _has_shape(hint)}


def _is_array(hint: Any) -> bool:
    return inspect.isclass(hint) and issubclass(hint, AbstractArray)


def _is_like(hint: Any) -> bool:
    """Whether a hint is `Like[ArrayLike, axes]`; the command line has annotations of another kind."""
    return get_origin(hint) is Annotated and isinstance(hint.__metadata__[0], str)


def _has_shape(hint: Any) -> bool:
    if _is_array(hint) or _is_like(hint) or any(_has_shape(part) for part in get_args(hint)):
        return True
    return inspect.isclass(hint) and bool(_fields(hint))


class _Finder(MetaPathFinder):
    """Finds the package's modules as ever, and has them checked once they are loaded."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: Any = None) -> ModuleSpec | None:
        if name.split(".")[0] != "rbpf" or name.startswith(COMPILED):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader)
        return spec


class _Loader(Loader):
    """Loads a module by another loader, then puts checked functions in place of its functions."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        _check_all(module, module.__name__)


def _check_all(holder: Any, module: str) -> None:
    for name, value in list(vars(holder).items()):
        if isinstance(value, FunctionType) and value.__module__ == module and name not in MADE_BY:
            setattr(holder, name, checked(value))
        elif isinstance(value, classmethod | staticmethod) and isinstance(value.__func__, FunctionType):
            setattr(holder, name, type(value)(checked(value.__func__)))
        elif isinstance(value, property) and isinstance(value.fget, FunctionType):
            setattr(holder, name, property(checked(value.fget), value.fset, value.fdel, value.__doc__))
        elif inspect.isclass(value) and value.__module__ == module and not inspect.isclass(holder):
            _check_all(value, module)
