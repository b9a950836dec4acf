"""Which of the visible points a camera measures: a tracker with active search and a fixed budget."""

import numpy as np

COLUMNS, ROWS = 5, 4
"""Cells of the image: new tracks begin where the cells hold fewest."""


class Tracker:
    """Keeps tracks from frame to frame and begins others where places are free.

    Points known beforehand are measured first. Tracks go on while the point is visible. Free places go to visible
    points that are in the map already, then to new ones; both spread over the image.
    """

    def __init__(
        self,
        known: np.ndarray,
        count: int,
        places: int,
        new_per_frame: int,
        turnover: float,
        dropout: float,
        rest_frames: int,
        image_px: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """Starts before the first frame.

        Args:
            known: (M,) points known beforehand.
            count: of points in the world, Q.
            places: most measurements per frame.
            new_per_frame: most points that enter the map per frame; the first frame takes as many as fit.
            turnover: probability per frame that a track is lost.
            dropout: probability per frame that a track goes on without a measurement.
            rest_frames: a lost point is not looked for during these.
            image_px: width and height.
            rng: generator.
        """
        self._known, self._places, self._new = known, places, new_per_frame
        self._turnover, self._dropout, self._rest_frames = turnover, dropout, rest_frames
        self._cell_px = np.array(image_px) / [COLUMNS, ROWS]
        self._rng = rng
        self._tracks = np.zeros(0, dtype=np.int64)
        self._mapped = np.zeros(count, dtype=bool)
        self._resting = np.zeros(count, dtype=np.int64)
        self._unknown = np.ones(count, dtype=bool)
        self._unknown[known] = False
        self._frame = 0

    def step(self, visible: np.ndarray, px: np.ndarray) -> np.ndarray:
        """Goes on by one frame.

        Args:
            visible: (Q,) bool.
            px: (Q, 2) where the points are in the image; only the visible ones count.

        Returns:
            (K,) int64 rows of the points to measure.
        """
        known = self._known[visible[self._known]]
        old = self._kept(visible)[: self._places - known.size]
        taken = np.concatenate([known, old])
        free = visible & self._unknown & (self._resting <= self._frame)
        free[old] = False
        again = self._begin(free & self._mapped, taken, px, self._places - taken.size)
        taken = np.concatenate([taken, again])
        room = self._places - taken.size
        new = self._begin(free & ~self._mapped, taken, px, min(room, self._new) if self._frame else room)
        self._mapped[new] = True
        self._tracks = np.concatenate([old, again, new])
        measured = self._rng.random(known.size + old.size) >= (self._dropout if self._frame else 0.0)
        self._frame += 1
        return np.concatenate([np.concatenate([known, old])[measured], again, new])

    def _kept(self, visible: np.ndarray) -> np.ndarray:
        """Tracks of the last frame whose points are visible and not lost."""
        tracks = self._tracks[visible[self._tracks]]
        lost = self._rng.random(tracks.size) < self._turnover
        self._resting[tracks[lost]] = self._frame + self._rest_frames
        return tracks[~lost]

    def _begin(self, candidates: np.ndarray, taken: np.ndarray, px: np.ndarray, count: int) -> np.ndarray:
        """Up to `count` candidates (a mask), one after the other from a cell that holds fewest."""
        choice = self._rng.permutation(np.flatnonzero(candidates))
        chosen = np.zeros(min(count, choice.size), dtype=np.int64)
        cell = self._cell(px[choice])
        filled = np.bincount(self._cell(px[taken]), minlength=COLUMNS * ROWS)
        for place in range(chosen.size):
            best = int(np.argmin(filled[cell]))
            chosen[place] = choice[best]
            filled[cell[best]] += 1
            choice, cell = np.delete(choice, best), np.delete(cell, best)
        return chosen

    def _cell(self, px: np.ndarray) -> np.ndarray:
        """Cell (K,) of pixels (K, 2)."""
        column, row = np.clip((px / self._cell_px).astype(np.int64), 0, [COLUMNS - 1, ROWS - 1]).T
        return row * COLUMNS + column
