"""Compiled kernels: which there are, whether they are in the cache, and compiling them with a word of warning."""

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
#: Of a source: that it imports compiled functions that others import, too.
_SHARED = re.compile(r"^from rbpf\.kernels(\.(?!signature)\w+)? import", re.MULTILINE)


def kernel_modules() -> list[str]:
    """Modules of `rbpf` with compiled functions of their own, without those only compiled into others, in a good order.

    The drivers of landmarks first, which take longest, and leave functions of `rbpf.kernels` in the cache; then what compiles
    these into its own, which takes long as well; then by length.
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
    """Compiles what is not in the cache, with a word and a bar, and returns those modules; `every` also loads and tries all.

    Some are compiled as they are loaded, others at their first call: nothing is left that would be announced again. As many
    modules are compiled at once, each in a process of its own, as there are cores.
    """
    import rbpf.kernels  # noqa: F401  (discards copies that are older than their sources)

    modules = kernel_modules()
    missing = [name for name in modules if not cached(name)]
    if missing:
        say(f"compiling {len(missing)} of {len(modules)} kernels: this takes a minute or two and is done once …")
        from joblib import Parallel, delayed

        with progress() as bar, Parallel(n_jobs=-1, return_as="generator_unordered") as parallel:
            report = bar("compiling")
            # What takes longest first, the calls that need others' kernels last.
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
    """To look for garbage, as often as Python does, among all that a compiler holds takes a tenth of its time."""
    gc.set_threshold(50_000, 20, 20)
    call()


def _move() -> None:
    """The motion of a stereo pair, as the systems do it, on a few numbers; likewise below."""
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


#: What is compiled at its first call.
FIRST_CALLS = (_drive, _move)
