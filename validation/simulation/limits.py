"""Checks of a simulation's options: one sentence for each that makes no sense."""

import math

from rbpf.errors import InputError


def check_counts(options: object, lowest: dict[str, int]) -> None:
    """Refuses numbers of things below these."""
    for name, least in lowest.items():
        value = getattr(options, name)
        if not (isinstance(value, int) and value >= least):
            raise InputError(f"{name} must be a whole number, at least {least}, got {value!r}")


def check_positive(options: object, *names: str) -> None:
    """Refuses what is not a positive finite number."""
    for name in names:
        value = getattr(options, name)
        if not (value > 0 and math.isfinite(value)):
            raise InputError(f"{name} must be a positive number, got {value!r}")


def check_not_negative(options: object, *names: str) -> None:
    """Refuses what is not a finite number, zero or more."""
    for name in names:
        value = getattr(options, name)
        if not (value >= 0 and math.isfinite(value)):
            raise InputError(f"{name} must be zero or a positive number, got {value!r}")


def check_fractions(options: object, *names: str) -> None:
    """Refuses what is no probability below one."""
    for name in names:
        value = getattr(options, name)
        if not 0 <= value < 1:
            raise InputError(f"{name} must be a probability, 0 or more and below 1, got {value!r}")


def check_order(options: object, low: str, high: str) -> None:
    """Refuses an empty interval."""
    if not getattr(options, low) < getattr(options, high):
        raise InputError(f"{low} = {getattr(options, low)!r} must be less than {high} = {getattr(options, high)!r}")
