"""Part of a recording: a time interval, every n-th of its frames, and images resized."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self, final

import numpy as np

from rbpf.errors import InputError
from rbpf.ranges import Count, NotNegative, check_ranges
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Source


@final
@dataclass(frozen=True)
class Part:
    """Which frames of a recording are used, and the size of its images.

    Raises InputError: a number is out of its range.
    """

    start_s: NotNegative = 0.0  #: start of the part, s after the recording's first frame.
    end_s: float | None = None  #: end of the part, s after the recording's first frame; None for the recording's end.
    every: Count = 1  #: of these every n-th.
    #: width to which images are reduced, px; the height follows. None keeps their size.
    resize_px: Count | None = None

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.end_s is not None and not self.end_s > self.start_s:
            raise InputError(f"end is {self.end_s:g} s: expected more than the start, {self.start_s:g} s")

    @classmethod
    def of(cls, entries: Mapping[str, Any]) -> Self:
        """The part stated in a run's config.yaml."""
        return cls(**{name: entries[name] for name in asdict(WHOLE) if name in entries})

    def entries(self) -> dict[str, float]:
        """The entries for a run's config.yaml, which `of` reads."""
        return {name: value for name, value in asdict(self).items() if value != getattr(WHOLE, name)}

    def apply(self, sequence: ImageSequence) -> ImageSequence:
        """The part of a sequence, with its camera; the images keep their times.

        Raises InputError: no image is left, or they would be enlarged.
        """
        stamps, camera = np.asarray(sequence.stamps_ns), sequence.camera
        rows = self.rows((stamps - stamps[:1]) * 1e-9, f"{sequence.name}: no image is left")
        width = camera.width if self.resize_px is None else self.resize_px
        if width > camera.width:
            raise InputError(f"images of {camera.width} px are not made larger: resize is {width} px")
        if width < camera.width:
            camera = camera.resized(width, max(round(width * camera.height / camera.width), 1))
        source = Chosen(sequence.source, rows, stamps[rows], (camera.height, camera.width))
        return replace(sequence, camera=camera, stamps_ns=stamps[rows], source=source)

    def rows(self, after_s: np.ndarray, problem: str, unit: str = "s") -> np.ndarray:
        """Indices of the frames used, from the times (T,) since the first, in `unit`.

        Raises InputError: none is left; the message starts with `problem`.
        """
        end_s = np.inf if self.end_s is None else self.end_s
        rows = np.flatnonzero((after_s >= self.start_s) & (after_s <= end_s))[:: self.every]
        if not rows.size:
            long = f"the recording is {round(after_s[-1], 3) if len(after_s) else 0} {unit} long"
            raise InputError(f"{problem} from {self.start_s:g} {unit} on: {long}")
        return rows


WHOLE = Part()


@final
@dataclass(frozen=True)
class Chosen(Source):
    """Some images of another source: rows (T,) and their times; they are reduced to `shape`, or None."""

    source: Source
    rows: np.ndarray
    stamps_ns: np.ndarray
    shape: tuple[int, int] | None = None

    def frames(self, start: int) -> Iterator[ImageFrame]:
        wanted = dict(zip(self.rows[start:].tolist(), self.stamps_ns[start:].tolist(), strict=True))
        if not wanted:
            return
        first = int(self.rows[start])
        for row, frame in enumerate(self.source.frames(first), first):
            if row in wanted:
                image, right = self._smaller(frame.image), self._smaller(frame.right)
                yield replace(frame, stamp_ns=wanted[row], image=image, right=right)
            if row == self.rows[-1]:
                return

    def _smaller(self, image: np.ndarray | None) -> np.ndarray | None:
        if image is None or self.shape is None or image.shape == self.shape:
            return image
        import cv2

        return np.asarray(cv2.resize(image, self.shape[::-1], interpolation=cv2.INTER_AREA))
