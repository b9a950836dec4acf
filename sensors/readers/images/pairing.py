"""Which images of two cameras were taken together."""

import numpy as np

from rbpf.errors import InputError

TOLERANCE_S = 0.005
"""Two images whose times differ by no more were taken together."""


def pair_stamps(
    left_ns: np.ndarray, right_ns: np.ndarray, tolerance_s: float, where: str
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Pairs of images, each the other's nearest in time, in order of time.

    Args:
        left_ns: (T,) int64 times of the left camera, in order.
        right_ns: (U,) of the right one.
        tolerance_s: largest difference.
        where: the recording, for messages.

    Returns:
        Rows (P,) of the left and (P,) of the right camera, and a sentence about each camera whose images are left out.

    Raises:
        InputError: no two images are near enough.
    """
    nearest, gap_ns = _nearest(left_ns, right_ns)
    back, _ = _nearest(right_ns, left_ns)
    # Of equal times the first counts for all: go there and back by time, not by row.
    mutual = left_ns[back[nearest]] == left_ns
    left = np.flatnonzero(mutual & (gap_ns <= round(tolerance_s * 1e9)))
    left = left[np.unique(nearest[left], return_index=True)[1]]
    right = nearest[left]
    if not left.size:
        least = f"the nearest two are {gap_ns.min() * 1e-9:.6f} s apart"
        action = "put both on one clock, or give a larger tolerance"
        raise InputError(
            f"{where}: no left and right image were taken within {tolerance_s:g} s, {least}; {action}."
        )
    notes = [
        f"{where}: {stamps.size - left.size} of {stamps.size} {side} images have no partner within {tolerance_s:g} s "
        "and are left out."
        for side, stamps in (("left", left_ns), ("right", right_ns))
        if stamps.size > left.size
    ]
    return left, right, tuple(notes)


def _nearest(stamps_ns: np.ndarray, among_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row (T,) of the nearest time, the earlier of two, and its distance (T,) in ns."""
    after = np.clip(np.searchsorted(among_ns, stamps_ns), 0, among_ns.size - 1)
    before = np.maximum(after - 1, 0)
    gap_before, gap_after = np.abs(stamps_ns - among_ns[before]), np.abs(stamps_ns - among_ns[after])
    return np.where(gap_before <= gap_after, before, after), np.minimum(gap_before, gap_after)
