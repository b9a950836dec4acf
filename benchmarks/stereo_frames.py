"""Time per 640 × 480 pair of the stereo system, on laboratory images in memory; 400 particles."""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.mono_frames import Decoded
from benchmarks.rows import Row, Settings
from examples.studies.lab import LabDrive, TexturedLab
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import ImageSequence, open_stereo
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.simulation.images import Imaging, simulate_images

RIG = RectifiedStereo(Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5), 0.12)
SETTLING, TIMED = 5, 30
STAGES = "features", "odometry", "matching", "filter"


def rendered(pairs: int) -> ImageSequence:
    """The start of the robot's tour, every second frame, with coarse texels."""
    world, imaging = TexturedLab(LabDrive(frames=pairs, every=2), texel_m=0.01), Imaging(known=0)
    with TemporaryDirectory() as folder:
        lab = Path(folder) / "lab"
        simulate_images(world, imaging, RIG, lab, seed=0)
        sequence = open_stereo(lab)
        held = Decoded(list(sequence.frames()))
    return replace(sequence, source=held)


def run(settings: Settings) -> list[Row]:
    """The system against only OpenCV's SIFT on both images, without matching, map or filter."""
    sequence = rendered(SETTLING + settings.repetitions(TIMED))
    log = filter_opened(open_pairs(sequence, StereoConfig.s05())).log
    whole = 1e3 * log["seconds"][SETTLING:]
    plain = 1e3 * sift_alone(sequence)
    median = float(np.median(whole))
    split = ", ".join(f"{name} {1e3 * log[f'seconds_{name}'][SETTLING:].mean():.3g} ms" for name in STAGES)
    return [
        Row(
            "stereo pair 640x480, 400 particles",
            median,
            "ms",
            "OpenCV's SIFT of both images in full size",
            plain,
            plain / median,
            notes=f"means: {split}; fastest {whole.min():.3g} ms; {log['features'].mean():.3g} features, "
            f"{int(log['updated'].sum())} updates in {len(log)} pairs",
            tolerance=0.5,
        )
    ]


def sift_alone(sequence: ImageSequence) -> float:
    """Median seconds per pair."""
    detector, seconds = cv2.SIFT.create(), []
    for frame in list(sequence.frames())[SETTLING::3]:
        start = time.perf_counter()
        for image in (frame.image, frame.right):
            detector.detectAndCompute(image, None)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))
