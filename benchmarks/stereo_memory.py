"""Peak memory of a process that updates 400 particles with 11,000 landmarks each.

The worst case: particles share no landmark estimate, as without any resampling.
"""

import json
import subprocess
import sys

from benchmarks.rows import Row, Settings

NUMBERS = 9
"""Numbers of a landmark's estimate: mean and covariance, with six distinct entries."""


def run(settings: Settings) -> list[Row]:
    """Measures in a separate process, against the memory of all estimates' numbers."""
    turns = settings.repetitions(6)
    told = subprocess.run(
        [sys.executable, "-m", "benchmarks.stereo_memory", str(turns)], capture_output=True, text=True, check=True
    ).stdout
    peak, before, landmarks, particles = json.loads(told.splitlines()[-1])
    floor = 8.0 * NUMBERS * landmarks * particles / 2**20
    return [
        Row(
            f"stereo memory, {particles} particles, {landmarks} landmarks each",
            peak,
            "MiB",
            "mean and covariance of every landmark in every particle",
            floor,
            floor / peak,
            notes=f"{before:.0f} MiB before the map is filled; nothing shared between particles; {turns} updates",
        )
    ]


def measure(turns: int) -> list[float]:
    """Peak and initial memory of this process in MiB, landmarks and particles."""
    from benchmarks.stereo_step import LARGE, Drive
    from rbpf.runs.folder import peak_memory_mb

    Drive(100, 1)()
    before = peak_memory_mb()
    drive = Drive(LARGE, turns)
    for _ in range(turns):
        drive()
    return [peak_memory_mb(), before, LARGE, drive.config.particles]


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]))))
