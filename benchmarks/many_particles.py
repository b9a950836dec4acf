"""50,000 particles that observe 30 landmarks: refine and weigh, the whole update, memory bandwidth, and threads."""

from collections.abc import Callable

import numba

from benchmarks.machine import copy_bandwidth
from benchmarks.rows import Row, Settings, Timing, interleaved
from benchmarks.worlds import Run, World, planar, spatial
from rbpf.core.particles import reweight
from rbpf.core.proposals import refined

N, K, M = 50_000, 30, 60
DWELL = 5
DOUBLE = 8


def refine_stage(run: Run) -> Callable[[], None]:
    """Refines and weighs with the next frame, without changing the filter."""
    filter_, frame = run.filter, run.frames[-1]

    def stage() -> None:
        transition = filter_.motion.transition(filter_.particles.state, frame.control, 1.0)
        prior = filter_.marginals.predict(transition, filter_.space, 1.0)
        groups = filter_.sensors[0].observe(frame, filter_.belief())
        proposed = refined(prior, filter_.marginals.information(prior.predicted(), groups, prior))
        reweight(filter_.particles.log_weights, proposed.log_w1, "benchmark")

    return stage


def on_threads(threads: int, call: Callable[[], None]) -> Callable[[], None]:
    """The call with the kernels on this number of threads."""

    def limited() -> None:
        allowed = numba.get_num_threads()
        numba.set_num_threads(threads)
        try:
            call()
        finally:
            numba.set_num_threads(allowed)

    return limited


def run(settings: Settings) -> list[Row]:
    """Rows in the plane, then in space."""
    return [row for world in (planar(K, M, DWELL), spatial(K, M, DWELL)) for row in figures(world, settings)]


def figures(world: World, settings: Settings) -> list[Row]:
    """Rates of both stages against memory bandwidth, and one thread against all."""
    space = "planar" if world.sight.dim == 2 else "spatial"
    turns = settings.repetitions(18)
    warm_up = 4
    slam = Run(world, N, 1 + 2 * (turns + warm_up))
    slam.step()
    threads = numba.config.NUMBA_NUM_THREADS
    times = interleaved(
        {
            "refine": lambda: refine_stage(slam)(),
            "update": slam.step,
            "refine, 1 thread": on_threads(1, lambda: refine_stage(slam)()),
            "update, 1 thread": on_threads(1, slam.step),
        },
        turns,
        warm_up=warm_up,
    )
    dim = world.sight.dim
    once = N * K * (dim + dim * (dim + 1) // 2) * DOUBLE
    bandwidth = copy_bandwidth()
    notes = f"{bandwidth / 1e9:.1f} GB/s copied; {slam.diversity.text()}"
    rows = [
        rate(f"refine 50000x30 {space}", times["refine"], once / bandwidth, notes),
        rate(f"update 50000x30 {space}", times["update"], 2 * once / bandwidth, notes),
    ]
    return rows + [
        speed_up(f"{stage} 50000x30 {space}", threads, times[stage], times[f"{stage}, 1 thread"])
        for stage in ("refine", "update")
    ]


def rate(name: str, timing: Timing, floor: float, notes: str) -> Row:
    hertz = 1.0 / timing.median
    return Row(
        name,
        hertz,
        "Hz",
        "the records alone, at copy bandwidth",
        1.0 / floor,
        hertz * floor,
        notes=f"{timing.spread}; {notes}",
        tolerance=0.5,
    )


def speed_up(name: str, threads: int, many: Timing, one: Timing) -> Row:
    return Row(
        f"{name}, threads",
        many.median * 1e3,
        "ms",
        "1 thread",
        one.median * 1e3,
        one.median / many.median,
        notes=f"{threads} threads",
        tolerance=0.4,
    )
