"""What a camera's numbers must be."""

from numbers import Integral, Real

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
