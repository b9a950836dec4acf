"""Which features of the pairs stand still: what the motion of the next pair is told by, and what the map may take."""

from typing import final

import numpy as np

from rbpf.core.checkpoint import checked


@final
class MotionSegmentation:
    """Follows the features from pair to pair. Call `look`, `match`, `leave_out`, then `note`."""

    def __init__(self) -> None:
        self._stood = np.zeros(0, dtype=np.int8)
        self.look()

    def look(self) -> None:
        """The next pair, of which nothing is known yet."""
        self.matches = np.zeros((2, 0), dtype=np.intp)
        """Rows (2, M) of the pair kept and of the pair looked at."""
        self.moving = self.matches[1]
        """Rows of features of the pair looked at that are of things that move."""

    def match(self, first: np.ndarray, second: np.ndarray) -> None:
        """Which rows (M,) of the pair kept are which (M,) of the pair looked at."""
        self.matches = np.stack([first, second])

    def before(self) -> np.ndarray:
        """Of each match (M,) what it was in the pair kept, see `rbpf.motion.stereo_motions.Known`."""
        return self._stood[self.matches[0]]

    def leave_out(self, moving: np.ndarray) -> None:
        """Which matches (M,) agree on another motion than the camera's."""
        self.moving = self.matches[1, moving]

    def note(self, count: int, agree: np.ndarray, found: np.ndarray) -> None:
        """The pair looked at is what the next one is matched with.

        Args:
            count: of its features.
            agree: (M,) matches that agree with the camera's motion; where none does, all stay what they were.
            found: rows of features that are where the map has them.
        """
        now = np.zeros(count, dtype=np.int8)
        first, second = self.matches
        if agree.any():
            now[second[agree]] = 1
        else:
            now[second] = self._stood[first]
        now[self.moving] = -1
        now[found] = 1
        self._stood = now

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {"pair/stood": self._stood}

    def restore(self, arrays: dict[str, np.ndarray], count: int) -> None:
        """The inverse of `arrays`, of a pair of so many features.

        Raises:
            InputError: they are not what they should be.
        """
        self._stood = checked(arrays, "pair/stood", (count,), "i").copy()
