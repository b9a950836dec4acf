"""A recording played forward and then backward: a path that sees again all that it has seen."""

from collections.abc import Iterator
from dataclasses import replace
from typing import final

import numpy as np

from rbpf.errors import InputError
from rbpf.sensors.feature_log import CameraTruth, FeatureLog
from rbpf.sensors.readers.images.sequence import ImageFrame, Source
from rbpf.sensors.readers.images.stereo import StereoSequence


@final
class Reordered(Source):
    """Images of a sequence in another order, with the times given; all are held.

    Args:
        sequence: of pairs.
        rows: (T,) which of its pairs.
        stamps_ns: (T,) their times.
    """

    def __init__(self, sequence: StereoSequence, rows: np.ndarray, stamps_ns: np.ndarray) -> None:
        self.images = list(sequence.frames())
        self.rows, self.stamps_ns = rows, stamps_ns

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """Images from number `start` on."""
        for row, stamp in zip(self.rows[start:].tolist(), self.stamps_ns[start:].tolist(), strict=True):
            yield replace(self.images[row], stamp_ns=stamp)


def pairs_there_and_back(sequence: StereoSequence) -> StereoSequence:
    """T pairs, then T − 1 backward, at an even pace.

    Raises:
        InputError: the recording has no truth, or less than two pairs.
    """
    count, truth = len(sequence), sequence.truth
    if truth is None or count < 2:
        raise InputError(f"{sequence.name}: expected two pairs or more, and ground truth")
    rows = there_and_back(count)
    stamps = np.arange(rows.size, dtype=np.int64) * int(np.median(np.diff(sequence.stamps_ns)))
    near = np.array([int(np.abs(truth.stamps_ns - stamp).argmin()) for stamp in sequence.stamps_ns.tolist()])
    true = CameraTruth(stamps, truth.world_from_camera[near][rows])
    source = Reordered(sequence, rows, stamps)
    return StereoSequence(replace(sequence.pair, stamps_ns=stamps, truth=true, source=source), sequence.rig)


def log_there_and_back(log: FeatureLog) -> FeatureLog:
    """T frames, then T − 1 backward; stamps count them. Truth, if there is any, has a pose for each frame."""
    rows = there_and_back(len(log.frames))
    frames = [replace(log.frames[row], stamp_ns=t) for t, row in enumerate(rows.tolist())]
    truth = log.truth
    if truth is not None:
        stamps = np.arange(rows.size, dtype=np.int64)
        truth = CameraTruth(stamps, truth.world_from_camera[rows], truth.landmarks)
    return replace(log, frames=frames, truth=truth)


def there_and_back(count: int) -> np.ndarray:
    """0 … T − 1 … 0, (2 T − 1,)."""
    return np.concatenate([np.arange(count), np.arange(count - 2, -1, -1)])
