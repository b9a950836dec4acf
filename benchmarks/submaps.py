"""Joining a finished sub-map to a long chain, and loop closure: on a circle, with 50 new landmarks in each sub-map."""

import time

import numpy as np

from benchmarks.rows import Row, Settings, Timing
from rbpf.lie import SE2
from rbpf.maps.joint.solution import SubMap
from rbpf.maps.joint.submaps import SubMaps

EACH, LENGTH_M, REACH_M = 50, 10.0, 2.0
STD = {"heading": 0.002, "place": 0.02, "landmark": 0.03}


def circle(count: int) -> list[SubMap]:
    """Sub-maps on a closed circle; the last one observes the landmarks of the first."""
    rng = np.random.default_rng(0)
    radius = LENGTH_M * count / (2.0 * np.pi)
    turns = np.linspace(0.0, 2.0 * np.pi, count + 1)
    ends = SE2.normalise(np.stack([turns + 0.5 * np.pi, radius * np.cos(turns), radius * np.sin(turns)], axis=1))
    along = np.sort(rng.uniform(0.0, 2.0 * np.pi, EACH * count))
    out = radius + rng.uniform(-6.0, 6.0, along.size)
    landmarks = np.stack([out * np.cos(along), out * np.sin(along)], axis=1)
    found = []
    for number in range(count):
        low, high = np.searchsorted(along, turns[number : number + 2] + np.array([-REACH_M, REACH_M]) / radius)
        ids = np.arange(low, high)
        if number == count - 1:
            ids = np.append(np.arange(np.searchsorted(along, REACH_M / radius)), ids)
        std = np.append([STD["heading"], STD["place"], STD["place"]], np.full(2 * ids.size, STD["landmark"]))
        error = std * rng.normal(size=std.size)
        points = SE2.inverse_transform(ends[number + 1], landmarks[ids]) + error[3:].reshape(-1, 2)
        end = SE2.retract(SE2.between(ends[number], ends[number + 1]), error[:3])
        found.append(SubMap(end, ids, points, np.diag(std**2)))
    return found


def run(settings: Settings) -> list[Row]:
    """The last tenth of the joins against the first; the loop closure is reported without a limit."""
    count = 600 if settings.quick else 2000
    maps, seconds = SubMaps(SE2, 2, 2 * EACH), []
    for finished in circle(count):
        begun = time.perf_counter()
        maps.join(finished)
        seconds.append(time.perf_counter() - begun)
    first, last = Timing(np.array(seconds[count // 20 : count // 10])), Timing(np.array(seconds[-count // 10 : -1]))
    ratio = last.median / first.median
    begun = time.perf_counter()
    maps.landmarks()
    told = time.perf_counter() - begun
    kept = sum(array.nbytes for array in maps.arrays().values()) / 2**20
    notes = (
        f"{count} sub-maps, {count * EACH} landmarks, {kept:.0f} MiB; closing the loop takes {seconds[-1]:.1f} s, "
        f"the covariances of all landmarks {told:.1f} s; {last.spread}"
    )
    return [
        Row(
            "joining a sub-map, far along", last.median * 1e3, "ms", "at the beginning", first.median * 1e3, ratio,
            higher=False, notes=notes, tolerance=0.15,
        )
    ]  # fmt: skip
