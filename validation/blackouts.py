"""Blackouts at many places of a sequence: does the camera find itself again, and is it then where it says?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rbpf.lie import SE3
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.relocalise import Attempt

SETTLED_S = 1.0
"""The pose is judged when the camera has been tracked again for so long."""

RIGHT_M, RIGHT_DEG = 0.1, 3.0
"""A pose is right when its error exceeds that of the undisturbed run in the same frame by no more than this."""

Verdict = Literal["rightly", "late", "wrongly", "not"]


@dataclass(frozen=True)
class Blackouts:
    """What is done to a sequence.

    Attributes:
        folder: of the sequence.
        config: of the filter.
        count: of blackouts, at even distances; fewer where there are not so many frames.
        first_s: the first one is not before this.
        dark_s: how long the light is out.
        within_s: how soon the camera must be found.
    """

    folder: Path
    config: MonoConfig
    count: int = 50
    first_s: float = 1.0
    dark_s: float = 1.0
    within_s: float = 2.0


@dataclass(frozen=True)
class Outcome:
    """After a blackout; T frames from the one before it on.

    Attributes:
        dark: frames without light.
        found: frame from which on the camera was not lost again, −1 where there is none.
        visible: landmarks of known depth in view when the light came back.
        errors_m: (T,) of the position.
        errors_deg: (T,) of the rotation.
        seconds_lost: median time of a frame with light in which it was still lost; NaN without one.
        attempts: to recognise the place, in the frames with light in which it was lost.
    """

    dark: range
    found: int
    visible: int
    errors_m: np.ndarray
    errors_deg: np.ndarray
    seconds_lost: float
    attempts: tuple[Attempt, ...]


@dataclass(frozen=True)
class Series:
    """All blackouts of a sequence.

    Attributes:
        name: of the sequence.
        rate_hz: of its images.
        within_s: how soon the camera must be found.
        outcomes: one for each blackout.
        way_m: (B,) how far the camera went in the dark.
        usual_m: (T,) error of the undisturbed run's position, all frames.
        usual_deg: (T,) of its rotation.
    """

    name: str
    rate_hz: float
    within_s: float
    outcomes: list[Outcome]
    way_m: np.ndarray
    usual_m: np.ndarray
    usual_deg: np.ndarray

    def seconds(self, outcome: Outcome) -> float:
        """From the first image with light to being found; infinite where it was not."""
        return (outcome.found - outcome.dark.stop) / self.rate_hz if outcome.found >= 0 else np.inf

    def judged(self, outcome: Outcome) -> int:
        """The frame in which the pose is judged: when the camera has been tracked again for a while, or the last."""
        last = outcome.dark.start - 2 + outcome.errors_m.size
        settled = max(outcome.found, outcome.dark.stop) + round(SETTLED_S * self.rate_hz)
        return min(settled, last)

    def error(self, outcome: Outcome) -> tuple[float, float]:
        """Of the pose that is judged, m and degrees."""
        row = self.judged(outcome) - outcome.dark.start + 1
        return float(outcome.errors_m[row]), float(outcome.errors_deg[row])

    def verdict(self, outcome: Outcome) -> Verdict:
        """Found rightly in time, rightly but late, at a wrong pose, or not."""
        if outcome.found < 0:
            return "not"
        frame, (metres, degrees) = self.judged(outcome), self.error(outcome)
        if metres > self.usual_m[frame] + RIGHT_M or degrees > self.usual_deg[frame] + RIGHT_DEG:
            return "wrongly"
        return "rightly" if self.seconds(outcome) <= self.within_s else "late"


def pose_differences(poses: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (T,) [m] and angles (T,) [degrees] between poses (T, 7)."""
    error = SE3.log(SE3.between(reference, poses))
    metres = np.linalg.norm(SE3.translation(poses) - SE3.translation(reference), axis=-1)
    return np.asarray(metres), np.rad2deg(np.linalg.norm(error[..., :3], axis=-1))
