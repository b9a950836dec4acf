"""A cache of a stereo sequence's features, to filter them repeatedly.

Decoding and SIFT take most of a pair's time, and do not depend on the filter's settings. `cache_features` continues after
an interruption: it stores chunks of pairs, each a file that appears once it is complete. `filter_cached` filters them: a
separate front end, `CachedFrontEnd`, passes the features to the system.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, final

import numpy as np

from rbpf.core.checkpoint import fitting, load_arrays, save_arrays
from rbpf.errors import InputError
from rbpf.runs.recordings import Opened, filter_opened
from rbpf.runs.run import Listener, Run
from rbpf.sensors.camera import RectifiedStereo
from rbpf.sensors.feature_log import Truth
from rbpf.sensors.features import Sift
from rbpf.sensors.readers import ImageSequence
from rbpf.sensors.stereo import StereoFeatures, StereoMatcher
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.front_end import ImageFrontEnd
from rbpf.systems.stereo.slam import StereoSlam

CHUNK = 100
"""Pairs in a file."""

FEATURES = "z", "cov", "scale", "orientation", "descriptors"
"""Stored fields of the features: without images there are no first views."""


@dataclass(frozen=True)
class CachedPair:
    """A pair with cached features.

    Attributes:
        stamp_ns: time of the pair.
        features: None if the pair could not be measured.
        problem: the reason, or another problem of the pair, in words.
        seconds: time of the measurement.
    """

    stamp_ns: int
    features: StereoFeatures | None
    problem: str
    seconds: float


@final
@dataclass(frozen=True)
class CachedSequence:
    """The features of a sequence, to filter instead of its images.

    Attributes:
        name: of the recording.
        rig: the two cameras.
        stamps_ns: (T,) int64 times of the pairs.
        truth: world_from_camera; None where unknown.
        folder: holds the features.
    """

    name: str
    rig: RectifiedStereo
    stamps_ns: np.ndarray
    truth: Truth | None
    folder: Path

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frames(self, start: int = 0) -> Iterator[CachedPair]:
        """Pairs from number `start` on."""
        for first in range(start - start % CHUNK, len(self), CHUNK):
            pairs = _read(self.folder, first, self.rig, self.stamps_ns[first : first + CHUNK])
            yield from pairs[max(start - first, 0) : len(self) - first]

    def first(self, count: int) -> "CachedSequence":
        """The first `count` pairs alone."""
        return CachedSequence(self.name, self.rig, self.stamps_ns[:count], self.truth, self.folder)


def cache_features(
    sequence: ImageSequence, config: StereoConfig, folder: Path, on_pair: Callable[[int, int], None] | None = None
) -> CachedSequence:
    """Measures the features that are not in `folder` yet.

    Args:
        sequence: the recording.
        config: only `sift` and `pair` matter; a run over the features needs the same.
        folder: for the files, created if necessary.
        on_pair: called with the number of pairs done and the total.

    Raises:
        InputError: the folder has features of another recording or of other settings, or a pair is refused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, sequence, config)
    matching = replace(config.pair, align=False)
    total, sift = len(sequence), StereoMatcher(sequence.rig, Sift(config.sift), matching)
    missing = [first for first in range(0, total, CHUNK) if not _file(folder, first).exists()]
    for first in missing:
        pairs = []
        for frame in islice(sequence.frames(first), CHUNK):
            started = time.process_time()
            features, problem = None, frame.problem or ""
            if frame.image is not None and frame.right is not None:
                features = sift.measure(frame.image, frame.right)
                problem = sift.remark
            pairs.append(CachedPair(int(frame.stamp_ns), features, problem, time.process_time() - started))
            if on_pair is not None:
                on_pair(first + len(pairs), total)
        _write(folder, first, pairs, config.sift.length)
    return CachedSequence(sequence.name, sequence.rig, sequence.stamps_ns, sequence.truth, folder)


class CachedFrontEnd(ImageFrontEnd):
    """A front end for cached features instead of images."""

    takes = CachedPair

    def features_of(self, frame: Any) -> tuple[StereoFeatures | None, str]:
        return frame.features, frame.problem

    def refusal(self, frame: Any) -> str:
        return ""


def filter_cached(
    sequence: CachedSequence, config: StereoConfig, listeners: Iterable[Listener] = ()
) -> Run[StereoSlam]:
    """Filters a sequence of cached features."""
    system = StereoSlam(sequence.rig, config, front_end=CachedFrontEnd(sequence.rig, config))
    return filter_opened(Opened(system, sequence, sequence.stamps_ns, sequence.truth), listeners)


def _file(folder: Path, first: int) -> Path:
    return folder / f"pairs_{first:06d}.npz"


def _claim(folder: Path, sequence: ImageSequence, config: StereoConfig) -> None:
    """Records the source of the features, or checks that it is the sequence."""
    stamps = sequence.stamps_ns
    ours = {
        "recording": sequence.name,
        "stamps_ns": [len(stamps), int(stamps[0]), int(stamps[-1])],
        "sift": asdict(config.sift),
        "pair": asdict(config.pair),
    }
    note = folder / "features.json"
    if not note.exists():
        note.write_text(json.dumps(ours, indent=2) + "\n", encoding="utf-8")
    elif json.loads(note.read_text(encoding="utf-8")) != ours:
        raise InputError(f"{folder} holds features of another recording or with other settings: choose another folder")


def _write(folder: Path, first: int, pairs: list[CachedPair], length: int) -> None:
    empty = {"z": (0, 3), "cov": (0, 3, 3), "scale": (0,), "orientation": (0,), "descriptors": (0, length)}
    arrays = {
        name: np.concatenate(
            [
                np.zeros(shape, dtype=np.float32 if name == "descriptors" else float),
                *(getattr(pair.features, name) for pair in pairs if pair.features is not None),
            ]
        )
        for name, shape in empty.items()
    }
    arrays["count"] = np.array([-1 if pair.features is None else len(pair.features) for pair in pairs])
    arrays["problem"] = np.array([pair.problem for pair in pairs], dtype=np.str_)
    arrays["seconds"] = np.array([pair.seconds for pair in pairs])
    save_arrays(_file(folder, first), arrays)


def _read(folder: Path, first: int, rig: RectifiedStereo, stamps_ns: np.ndarray) -> list[CachedPair]:
    path = _file(folder, first)
    arrays, pairs, at = load_arrays(path), [], 0
    with fitting(path):
        # The last file may have more pairs than a part of the sequence.
        entries = (arrays[name].tolist() for name in ("count", "problem", "seconds"))
        for stamp_ns, count, problem, seconds in zip(stamps_ns.tolist(), *entries, strict=False):
            features = None
            if count >= 0:
                features = StereoFeatures.measured(rig, *(arrays[name][at : at + count] for name in FEATURES))
                at += count
            pairs.append(CachedPair(stamp_ns, features, problem, seconds))
    return pairs
