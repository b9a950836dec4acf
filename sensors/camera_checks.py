"""What a camera's numbers must be."""

from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

from rbpf.errors import InputError


def check_size(name: str, value: object) -> None:
    """Refuses what is no positive whole number."""
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) <= 0:
        raise InputError(f"the camera's {name} must be a positive whole number of pixels, got {value!r}")


def check_finite(what: str, value: object) -> None:
    """Refuses what is no finite number."""
    if not isinstance(value, Real) or not np.isfinite(float(value)):
        raise InputError(f"{what} must be a finite number, got {value!r}")


def check_lens(lenses: Mapping[str, Any], model: str, distortion: Any) -> None:
    """Refuses another model of distortion, and another number of coefficients than it has."""
    if model not in lenses:
        raise InputError(f"the camera's distortion_model must be {' or '.join(lenses)}, got {model!r}")
    names = lenses[model].coefficient_names
    if np.shape(distortion) != (len(names),):
        left_out = " (k3 = 0 if there are four)" if len(names) == 5 else ""
        expected = f"the {len(names)} numbers {', '.join(names)}{left_out}"
        raise InputError(f"the camera's distortion must be {expected}, got {distortion!r}")
    for name, number in zip(names, distortion, strict=True):
        check_finite(f"the camera's {name}", number)
