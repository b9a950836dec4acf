"""Time of a monocular frame by the number of landmarks in the map (E06 Fig. 3): their selection is O(M)."""

from dataclasses import replace

import numpy as np

from benchmarks.mono_frames import SETTLING, Decoded, rendered
from benchmarks.rows import Row, Settings
from rbpf.core.models import Records
from rbpf.lie import SE3
from rbpf.maps.point import Point
from rbpf.runs.recordings import filter_opened, open_mono
from rbpf.runs.run import Run
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.system import Tracked

WIDTH, TIMED = 320, 60
LANDMARKS = 10_000
BEHIND_M = 5.0
"""Distance of the additional landmarks behind the first camera: none comes into view, but all are checked."""


def run(settings: Settings) -> list[Row]:
    """One desk twice: with its own landmarks only, and with ten thousand more in the map from frame one on."""
    frames = SETTLING + settings.repetitions(TIMED)
    sequence, known = rendered(WIDTH, frames)
    held = sequence.source
    assert isinstance(held, Decoded)
    seconds = {}
    for more in (0, LANDMARKS):

        def fill(run: Run, _: Tracked, more: int = more) -> None:
            if len(run.log) == 1 and more:
                add_elsewhere(run, more)

        done = filter_opened(open_mono(replace(sequence), MonoConfig(particles=50, map="particles"), known), [fill])
        assert not done.log.lost().any()
        spent = done.log["seconds"]
        seconds[more] = spent[SETTLING:]
    few, many = (float(np.median(part)) for part in seconds.values())
    return [
        Row(
            f"mono frame, {LANDMARKS} landmarks",
            many * 1e3,
            "ms",
            "the desk's own landmarks",
            few * 1e3,
            many / few,
            higher=False,
            notes=f"fastest {seconds[LANDMARKS].min() * 1e3:.3g} against {seconds[0].min() * 1e3:.3g} ms",
            tolerance=0.15,
        )
    ]


def add_elsewhere(run: Run, count: int) -> None:
    """Adds landmarks out of view; each has a row in the table of appearances, as if it had been visited."""
    rng, filter_, table = np.random.default_rng(0), run.system.filter, run.system.sensor.table
    pose = filter_.particles.state[0, :7]
    behind = rng.uniform([-3.0, -3.0, -BEHIND_M - 2.0], [3.0, 3.0, -BEHIND_M], (count, 3))
    points = SE3.transform(pose, behind)
    n, landmark_map = filter_.n, filter_.belief().map
    mean = np.broadcast_to(points, (n, count, 3))
    source = np.zeros((count, *table.first_patch.shape[1:]), dtype=np.uint8)
    rows = table.add(source, np.zeros((count, 2)), pose)
    table.position[rows] = np.concatenate([points, np.ones((count, 1))], axis=1)
    cov = np.broadcast_to(1e-4 * np.eye(3), (n, count, 3, 3))
    landmark_map.add_records(Records(mean, cov), Point(3), ids=rows)
