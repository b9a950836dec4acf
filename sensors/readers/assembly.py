"""Puts arrays of motions and sightings together into frames, and checks what all logs have in common."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rbpf.lie import Array
from rbpf.sensors.readers.log import Frame
from rbpf.sensors.readers.table import Table


def require_observations(table: Table, distance: str, *angles: str) -> None:
    """Refuse ranges that are not positive and angles beyond a turn, which are probably degrees.

    Raises:
        InputError: names the first line that holds one.
    """
    table.require(table[distance] > 0, distance, "positive")
    for angle in angles:
        table.require(np.abs(table[angle]) <= 2 * np.pi, angle, "in radians, within a turn")


def require_distinct(table: Table, frame: NDArray[np.int64], landmarks: NDArray[np.int64], when: str) -> None:
    """Refuse a landmark that one frame sees twice.

    Args:
        table: n sightings.
        frame: (n,) their frame.
        landmarks: (n,) their landmark.
        when: what the log calls a frame.

    Raises:
        InputError: names the second line.
    """
    _, first = np.unique(np.stack([frame, landmarks], axis=1), axis=0, return_index=True)
    if len(first) < len(frame):
        row = int(np.setdiff1d(np.arange(len(frame)), first)[0])
        problem = f"landmark {landmarks[row]} comes a second time in {when} {frame[row]}, expected it once"
        raise table.error(row, problem)


def diagonal(std: list[Array]) -> Array:
    """(n, p, p) covariance of independent components from p arrays (n,) of standard deviations."""
    return np.square(np.stack(std, axis=1))[:, :, None] * np.eye(len(std))


def assemble(
    stamps_ns: NDArray[np.int64],
    delta: Array,
    cov_delta: Array,
    frame: NDArray[np.int64],
    landmarks: NDArray[np.int64],
    z: Array,
    cov_z: Array,
) -> list[Frame]:
    """Frames in order.

    Args:
        stamps_ns: (T,) time of each frame.
        delta: (T - 1, E) motion from each frame to the next.
        cov_delta: (T - 1, d, d) its covariance.
        frame: (S,) frame of each sighting, in order.
        landmarks: (S,) its landmark.
        z: (S, p) its measurement.
        cov_z: (S, p, p) its covariance.

    Returns:
        T frames; one without a sighting is empty.
    """
    bounds = np.searchsorted(frame, np.arange(len(stamps_ns) + 1))
    return [
        Frame(
            stamp_ns=int(stamps_ns[t]),
            delta=delta[t - 1] if t else None,
            cov_delta=cov_delta[t - 1] if t else None,
            landmarks=landmarks[start:stop],
            z=z[start:stop],
            cov_z=cov_z[start:stop],
        )
        for t, (start, stop) in enumerate(pairwise(bounds))
    ]
