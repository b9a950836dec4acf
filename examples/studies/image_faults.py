"""Fault injection in images: functions from a sequence of images or pairs to a damaged one.

    damaged = black_out(60, 30)(open_images("desk"))

The rest of the sequence, including ground truth, is unchanged. Faults can be composed, and are deterministic: a sequence
read again, or from another frame on, gives the same bytes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Source
from rbpf.sensors.readers.part import Chosen

Fault = Callable[[ImageSequence], ImageSequence]
Paint = Callable[[int, np.ndarray, bool], np.ndarray]
"""Changes image (H, W) uint8 number t, of the left or right camera."""


@dataclass(frozen=True)
class Painted(Source):
    """Images of another source, each changed."""

    source: Source
    paint: Paint

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        for t, frame in enumerate(self.source.frames(start), start):
            left, right = (
                None if image is None else self.paint(t, image, is_right)
                for image, is_right in ((frame.image, False), (frame.right, True))
            )
            yield replace(frame, image=left, right=right)


@dataclass(frozen=True)
class Unreadable(Source):
    """Images of another source, some of which cannot be read."""

    source: Source
    rows: frozenset[int]

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """From number `start` on."""
        for t, frame in enumerate(self.source.frames(start), start):
            problem = "the file is damaged, incomplete or no image"
            yield ImageFrame(frame.stamp_ns, None, None, problem) if t in self.rows else frame


def keep_every(step: int) -> Fault:
    """A slower camera: every n-th image."""
    return lambda sequence: _chosen(sequence, np.arange(0, len(sequence), step))


def drop_frames(fraction: float, seed: int = 0) -> Fault:
    """Drops a fraction of the images silently, never the first one."""

    def fault(sequence: ImageSequence) -> ImageSequence:
        kept = np.random.default_rng(seed).random(len(sequence)) >= fraction
        kept[0] = True
        return _chosen(sequence, np.flatnonzero(kept))

    return fault


def truncate_files(fraction: float, seed: int = 0) -> Fault:
    """A fraction of the images cannot be read, never the first one."""

    def fault(sequence: ImageSequence) -> ImageSequence:
        bad = np.random.default_rng(seed).random(len(sequence)) < fraction
        rows = frozenset((np.flatnonzero(bad[1:]) + 1).tolist())
        return _with_source(sequence, lambda source: Unreadable(source, rows))

    return fault


def black_out(first: int, count: int) -> Fault:
    """Darkness: images from number `first` on are black."""
    return painted(lambda t, image, _: np.zeros_like(image) if first <= t < first + count else image)


def jump_exposure(every: int, least: float = 0.4, most: float = 1.8, seed: int = 0) -> Fault:
    """The camera's gain jumps at regular intervals, between these factors; the first images are unchanged."""

    def paint(t: int, image: np.ndarray, is_right: bool) -> np.ndarray:
        if t < every:
            return image
        gain = np.random.default_rng([seed, t // every]).uniform(np.log(least), np.log(most))
        return np.clip(np.rint(image * np.exp(gain)), 0, 255).astype(np.uint8)

    return painted(paint)


def blur_motion(length_px: int, first: int = 1, count: int | None = None) -> Fault:
    """Motion blur along a line of this length, whose direction varies from image to image; never in the first one."""

    def paint(t: int, image: np.ndarray, is_right: bool) -> np.ndarray:
        if t < max(first, 1) or (count is not None and t >= first + count):
            return image
        along = np.arange(length_px) - (length_px - 1) / 2
        steps = np.rint(np.stack([along * np.sin(0.7 * t), along * np.cos(0.7 * t)], axis=-1)).astype(int)
        edge = int(np.abs(steps).max())
        padded = np.pad(image, edge, mode="edge").astype(np.float32)
        height, width = image.shape
        total = np.zeros(image.shape, np.float32)
        for down, across in steps + edge:
            total += padded[down : down + height, across : across + width]
        return np.rint(total / length_px).astype(np.uint8)

    return painted(paint)


def salt_and_pepper(fraction: float, seed: int = 0) -> Fault:
    """A fraction of the pixels is black or white, different ones in every image; none in the first one."""

    def paint(t: int, image: np.ndarray, is_right: bool) -> np.ndarray:
        if t == 0:
            return image
        rng = np.random.default_rng([seed, t, is_right])
        struck = rng.random(image.shape, dtype=np.float32) < fraction
        changed = image.copy()
        changed[struck] = np.where(rng.random(int(struck.sum())) < 0.5, 0, 255)
        return changed

    return painted(paint)


def cover_view(fraction: float, first: int, count: int, disparity_px: int = 12, seed: int = 0) -> Fault:
    """A textured object, as high as the image and a fraction of its width, moves through the view.

    Args:
        fraction: of the width.
        first: image in which it enters at the left.
        count: number of images until it has left at the right.
        disparity_px: its disparity.
        seed: of its texture.
    """

    def paint(t: int, image: np.ndarray, is_right: bool) -> np.ndarray:
        if not first <= t < first + count:
            return image
        height, width = image.shape
        size = round(fraction * width)
        left = round((t - first + 1) / (count + 1) * (width + size)) - size - disparity_px * is_right
        columns = np.arange(max(left, 0), max(min(left + size, width), 0))
        changed = image.copy()
        changed[:, columns] = _blobs(height, size, seed)[:, columns - left]
        return changed

    return painted(paint)


def wrong_focal(factor: float) -> Fault:
    """The calibration's focal lengths are wrong by a factor."""

    def fault(sequence: ImageSequence) -> ImageSequence:
        camera = replace(sequence.camera, fx=factor * sequence.camera.fx, fy=factor * sequence.camera.fy)
        return replace(sequence, camera=camera)

    return fault


def jitter_stamps(std_s: float, seed: int = 0) -> Fault:
    """Stamps with random errors, still in order; the first one is exact."""

    def fault(sequence: ImageSequence) -> ImageSequence:
        error = 1e9 * std_s * np.random.default_rng(seed).standard_normal(len(sequence))
        error[0] = 0.0
        jittered = np.sort(np.maximum(sequence.stamps_ns + np.rint(error).astype(np.int64), sequence.stamps_ns[0]))
        return _chosen(sequence, np.arange(len(sequence)), jittered)

    return fault


def painted(paint: Paint) -> Fault:
    """A fault that changes single images."""
    return lambda sequence: _with_source(sequence, lambda source: Painted(source, paint))


def _blobs(height: int, width: int, seed: int) -> np.ndarray:
    """A texture (H, W) uint8 of corners: random grey squares of eight pixels."""
    squares = np.random.default_rng(seed).integers(20, 235, (height // 8 + 1, width // 8 + 1), dtype=np.uint8)
    return np.kron(squares, np.ones((8, 8), np.uint8))[:height, :width]


def _chosen(sequence: ImageSequence, rows: np.ndarray, stamps_ns: np.ndarray | None = None) -> ImageSequence:
    stamps = sequence.stamps_ns[rows] if stamps_ns is None else stamps_ns
    return replace(sequence, stamps_ns=stamps, source=Chosen(sequence.source, rows, stamps))


def _with_source(sequence: ImageSequence, change: Callable[[Source], Source]) -> ImageSequence:
    return replace(sequence, source=change(sequence.source))
