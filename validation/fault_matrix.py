"""What a system makes of damaged sequences: what it says, whether it recovers, how far off it is."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from re import sub
from typing import Any

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.sensors.readers.images import ImageSequence, KnownPixels, StereoSequence
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import run_images
from rbpf.systems.stereo.config import StereoConfig
from rbpf.systems.stereo.run import run_images as run_pairs
from rbpf.validation.blackouts import pose_differences
from rbpf.validation.image_faults import (
    Fault,
    black_out,
    blur_motion,
    cover_view,
    drop_frames,
    jitter_stamps,
    jump_exposure,
    salt_and_pepper,
    truncate_files,
    wrong_focal,
)
from rbpf.validation.metrics.mono_scores import true_path

NONE = "none"
RIGHT_M, RIGHT_DEG = 0.03, 2.0
"""A pose is right when its error exceeds that of the undamaged run by no more than this."""

END = 10
"""Frames at the end by whose median error it is judged whether a run is right again."""


@dataclass(frozen=True)
class Told:
    """What a run tells of itself.

    Attributes:
        stamps_ns: (T,) of the frames that were filtered.
        poses: (T, 7) in the truth's world.
        lost: (T,) frames in which the run says that it does not see where it is.
        problems: what it says.
        failure: why it ended early.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray
    lost: np.ndarray
    problems: list[str]
    failure: str | None


@dataclass(frozen=True)
class Outcome:
    """A fault and what became of it.

    Attributes:
        system: that ran.
        fault: what was done to its input.
        frames: filtered, of those that the damaged sequence has.
        lost: in so many of them the run says that it does not see where it is.
        rmse_m: error of the position over all frames.
        last_m: median error of the last frames; NaN where there are none.
        last_deg: of the rotation.
        verdict: "as without", "recovers", "lost", "wrong" (and does not know it), "stopped" or "refused".
        said: what the run says, each sentence once.
    """

    system: str
    fault: str
    frames: int
    lost: int
    rmse_m: float
    last_m: float
    last_deg: float
    verdict: str
    said: str


def usual_faults(rate_hz: float, frames: int) -> dict[str, Fault[Any]]:
    """The faults that the documentation reports, for a recording of about five seconds."""
    second, first = round(rate_hz), 2 * frames // 5
    return {
        "10 % of the frames dropped": drop_frames(0.1),
        "30 % of the frames dropped": drop_frames(0.3),
        "10 % of the files truncated": truncate_files(0.1),
        "1 s blackout": black_out(first, second),
        "exposure jumps, x0.4 to x1.8, every 0.5 s": jump_exposure(max(second // 2, 1)),
        "1 s of motion blur, 15 px": blur_motion(15, first, second),
        "5 px of motion blur throughout": blur_motion(5),
        "salt and pepper, 2 %": salt_and_pepper(0.02),
        "a third covered by a moving object, 2 s": cover_view(1 / 3, first, 2 * second),
        "focal length 2 % too long": wrong_focal(1.02),
        "focal length 10 % too long": wrong_focal(1.1),
        "stamps with 5 ms of jitter": jitter_stamps(0.005),
    }


def try_mono(
    sequence: ImageSequence, known: KnownPixels | None, config: MonoConfig, faults: Mapping[str, Fault[Any]]
) -> list[Outcome]:
    """The monocular system on a sequence with ground truth, undamaged first; no alignment with known points.

    Raises:
        InputError: the sequence has no ground truth.
    """

    def run(damaged: ImageSequence) -> Told:
        done = run_images(damaged, config, known)
        return Told(done.stamps_ns, done.world_from_camera, done.lost, done.problems, done.failure)

    return _try_all("mono", sequence, run, faults)


def try_stereo(
    sequence: StereoSequence, config: StereoConfig, faults: Mapping[str, Fault[Any]]
) -> list[Outcome]:
    """The stereo system on a sequence with ground truth, undamaged first; the first true camera is the world.

    Raises:
        InputError: the sequence has no ground truth.
    """

    def run(damaged: StereoSequence) -> Told:
        done = run_pairs(damaged, config)
        blind = done.assumed > 0
        truth = _truth(damaged, done.stamps_ns)
        poses = SE3.compose(truth[0], done.world_from_camera)
        return Told(done.stamps_ns, poses, blind, done.notes, done.failure)

    return _try_all("stereo", sequence, run, faults)


def _try_all(
    system: str, sequence: Any, run: Callable[[Any], Told], faults: Mapping[str, Fault[Any]]
) -> list[Outcome]:
    clean = judged(system, NONE, sequence, run, None)
    return [clean, *(judged(system, name, fault(sequence), run, clean) for name, fault in faults.items())]


def judged(
    system: str, fault: str, damaged: Any, run: Callable[[Any], Told], clean: Outcome | None
) -> Outcome:
    """Runs one damaged sequence.

    Args:
        system: its name.
        fault: the fault's name.
        damaged: the sequence.
        run: filters it.
        clean: the outcome without a fault; None where this is it.
    """
    try:
        told = run(damaged)
    except InputError as error:
        nan = float("nan")
        return Outcome(system, fault, 0, 0, nan, nan, nan, "refused", str(error))
    metres, degrees = pose_differences(told.poses, _truth(damaged, told.stamps_ns))
    outcome = Outcome(
        system=system,
        fault=fault,
        frames=told.stamps_ns.size,
        lost=int(told.lost.sum()),
        rmse_m=float(np.sqrt(np.square(metres).mean())),
        last_m=float(np.median(metres[-END:])),
        last_deg=float(np.median(degrees[-END:])),
        verdict="as without",
        said="; ".join(summarised(told.problems + ([told.failure] if told.failure else []))),
    )
    return replace(outcome, verdict=_verdict(outcome, told, clean))


def _verdict(outcome: Outcome, told: Told, clean: Outcome | None) -> str:
    if told.failure is not None:
        return "stopped"
    if told.lost[-1]:
        return "lost"
    least_m, least_deg = (0.0, 0.0) if clean is None else (clean.last_m, clean.last_deg)
    if outcome.last_m > least_m + RIGHT_M or outcome.last_deg > least_deg + RIGHT_DEG:
        return "wrong"
    return "recovers" if outcome.lost > (0 if clean is None else clean.lost) else "as without"


def summarised(problems: list[str]) -> list[str]:
    """Each sentence once, without the frames' numbers, and how often it came."""
    counts = Counter(sub(r"^(frame|pair) \d+( of [^:]*)?:? ", "", problem) for problem in problems)
    return [text if count == 1 else f"{text} (x{count})" for text, count in counts.items()]


def _truth(sequence: ImageSequence | StereoSequence, stamps_ns: np.ndarray) -> np.ndarray:
    truth = true_path(sequence.truth, stamps_ns)
    if truth is None:
        raise InputError(f"{sequence.name} has no ground truth to judge a damaged run by")
    rows = np.clip(np.searchsorted(truth.rows, np.arange(stamps_ns.size)), 0, truth.rows.size - 1)
    return truth.world_from_camera[rows]
