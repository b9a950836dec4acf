"""Signatures say the shapes of their arrays, and the tests check them."""

import inspect
import os
from types import FunctionType
from typing import get_args, get_origin

import numpy as np
import pytest
from jaxtyping import Float

import rbpf.core.models
import rbpf.gaussian
import rbpf.lie
import rbpf.sensors.camera
from rbpf.core.models import Records
from rbpf.lie import SE2
from rbpf.sensors.camera import Pinhole
from tests.shapes import ShapeError, checked

PUBLIC = [rbpf.gaussian, rbpf.lie, rbpf.core.models, rbpf.sensors.camera]
on = pytest.mark.skipif(os.environ.get("RBPF_SHAPES") == "0", reason="shapes are not checked in this run")


def public_functions():
    for module in PUBLIC:
        for name, value in vars(module).items():
            if name.startswith("_") or not getattr(value, "__module__", "").startswith("rbpf."):
                continue
            if isinstance(value, FunctionType):
                yield f"{module.__name__}.{name}", value
            elif inspect.isclass(value):
                methods = [member for key, member in vars(value).items() if key == "__init__" or key[0] != "_"]
                yield from (
                    (f"{value.__qualname__}.{method.__name__}", method)
                    for method in methods
                    if isinstance(method, FunctionType)
                )


def test_no_array_of_a_public_signature_is_without_its_shape():
    bare = [
        f"{where}: {name}"
        for where, function in public_functions()
        for name, hint in function.__annotations__.items()
        if np.ndarray in (hint, *get_args(hint)) and get_origin(hint) is not dict
    ]
    assert not bare


@pytest.mark.parametrize("wrong", [{"cov": np.zeros((3, 1, 2, 2))}, {"const": np.zeros((3, 2))}])
def test_arrays_that_are_handed_over_together_agree(wrong):
    def handed_over(records: Records) -> None: ...

    sound = {"mean": np.zeros((3, 2, 2)), "cov": np.zeros((3, 2, 2, 2)), "const": np.zeros((3, 2, 7))}
    checked(handed_over)(Records(**sound))
    with pytest.raises(ShapeError, match="records"):
        checked(handed_over)(Records(**{**sound, **wrong}))


@on
def test_a_result_is_compared_with_the_arguments_broadcast():
    assert SE2.compose(np.zeros((4, 1, 3)), np.zeros((5, 3))).shape == (4, 5, 3)
    camera = Pinhole(320, 240, 200.0, 200.0, 159.5, 119.5)
    with pytest.raises(ShapeError, match="point"):
        camera.project(np.zeros((5, 4)))  # the fourth number would be ignored


@on
def test_what_passed_with_one_argument_does_not_pass_with_another():
    def zeros(n: int) -> Float[np.ndarray, " {n}"]:
        return np.zeros(3)

    watched = checked(zeros)
    watched(3)
    with pytest.raises(ShapeError, match="return"):
        watched(2)
