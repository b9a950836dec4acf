"""Compiled kernels: their modules, whether they are cached, and compilation with progress messages."""

import gc
import re
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import rbpf
from rbpf.cli.showing import progress, say

_ROOT = Path(rbpf.__file__).parent
#: Matches a source that imports compiled functions shared with others.
_SHARED = re.compile(r"^from rbpf\.kernels(\.(?!signature)\w+)? import", re.MULTILINE)


def kernel_modules() -> list[str]:
    """Modules of `rbpf` with compiled functions of their own, without those only compiled into others, in compilation order.

    The drivers of landmarks first, which take longest and leave functions of `rbpf.kernels` in the cache; then modules that
    compile these into their own, which also take long; then by length.
    """
    paths = [*(_ROOT / "kernels").glob("*.py")]
    for folder in ("sensors", "motion", "maps", "systems", "validation"):
        paths += (_ROOT / folder).rglob("*kernel*.py")
    sources = {path: path.read_text(encoding="utf-8") for path in paths}
    compiled = {path: s.count("@njit(") + s.count("@observation_kernel") for path, s in sources.items()}
    chosen = [path for path, count in compiled.items() if count > sources[path].count("inline=")]
    waits = {path: path.parent.name != "kernels" and bool(_SHARED.search(sources[path])) for path in chosen}
    chosen.sort(key=lambda path: (path.stem != "landmarks", not waits[path], -len(sources[path]), path))
    return [".".join(["rbpf", *path.relative_to(_ROOT).with_suffix("").parts]) for path in chosen]


def cached(module: str) -> bool:
    """Whether a compiled copy of a module's functions is in Numba's cache."""
    name = module.rpartition(".")[2]
    import numba

    source = _ROOT.joinpath(*module.split(".")[1:]).resolve()
    if numba.config.CACHE_DIR:  # in which a folder's name begins with that of the sources'
        return any(Path(numba.config.CACHE_DIR).glob(f"{source.parent.name}_*/{name}.*.nbi"))
    return any((source.parent / "__pycache__").glob(f"{name}.*.nbi"))


def compile_kernels(every: bool = False) -> list[str]:
    """Compiles modules that are not cached, with messages, and returns them; `every` also loads and tests all.

    Some are compiled on import, others at their first call: none is left to be announced later. Modules are compiled in
    parallel, each in its own process, one per core.
    """
    import rbpf.kernels  # noqa: F401  (discards copies that are older than their sources)

    modules = kernel_modules()
    missing = [name for name in modules if not cached(name)]
    if missing:
        say(f"compiling {len(missing)} of {len(modules)} kernels: this takes a minute or two and is done once …")
        from joblib import Parallel, delayed

        with progress() as bar, Parallel(n_jobs=-1, return_as="generator_unordered") as parallel:
            report = bar("compiling")
            # The slowest first, the calls that need others' kernels last.
            calls = [*(partial(import_module, name) for name in missing), *FIRST_CALLS]
            jobs = [delayed(_with_little_garbage)(call) for call in calls]
            jobs.insert(1, jobs.pop())
            for done, _ in enumerate(parallel(jobs), 1):
                report(done, len(jobs))
    if every:
        for name in modules:
            import_module(name)
        for call in FIRST_CALLS:
            call()
    return missing


def _with_little_garbage(call: Callable[[], object]) -> None:
    """Disables garbage collection, which takes a tenth of a compiler's time."""
    gc.set_threshold(50_000, 20, 20)
    call()


def _move() -> None:
    """Calls stereo odometry as the systems do, on a few numbers; likewise below."""
    import numpy as np

    from rbpf.motion.stereo_geometry import Matches
    from rbpf.motion.stereo_vo import estimate_motion
    from rbpf.sensors.camera import Pinhole, RectifiedStereo

    rng = np.random.default_rng(0)
    rig = RectifiedStereo(Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5), 0.12)
    before = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 5.0], (40, 3))
    z_prev, z_now = rig.project(before), rig.project(before + np.array([0.02, 0.0, 0.05]))
    estimate_motion(Matches.checked(rig, z_prev, z_now, np.eye(3), np.eye(3)), rng)


def _drive() -> None:
    """A robot's log."""
    from rbpf.runs.recordings import RobotRecording, filter_recording
    from rbpf.systems.range_bearing.config import RangeBearingConfig
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(5, 20, False), Path(folder) / "log", 0)
        filter_recording(RobotRecording(Path(folder) / "log"), RangeBearingConfig(particles=10))


#: Functions compiled at their first call.
FIRST_CALLS = (_drive, _move)
