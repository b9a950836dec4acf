"""Compiled kernels: which there are, whether they are in the cache, and compiling them with a word of warning."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import rbpf
from rbpf.cli.showing import progress, say

_ROOT = Path(rbpf.__file__).parent


def kernel_modules() -> list[str]:
    """Modules of `rbpf` with compiled functions of their own; those that are only compiled into others are left out."""
    folders = "sensors", "motion", "maps", "systems", "validation"
    paths = [*sorted((_ROOT / "kernels").glob("*.py"))]
    for folder in folders:
        paths += sorted((_ROOT / folder).rglob("*_kernel*.py"))
    sources = {path: path.read_text(encoding="utf-8") for path in paths}
    compiled = {path: s.count("@njit(") + s.count("@observation_kernel") for path, s in sources.items()}
    chosen = [path for path, count in compiled.items() if count > sources[path].count('inline="always"')]
    return [".".join(["rbpf", *path.relative_to(_ROOT).with_suffix("").parts]) for path in chosen]


def cached(module: str) -> bool:
    """Whether a compiled copy of a module's functions is in Numba's cache."""
    name = module.rpartition(".")[2]
    import numba

    if numba.config.CACHE_DIR:
        return any(Path(numba.config.CACHE_DIR).glob(f"*/{name}.*.nbi"))
    source = _ROOT.joinpath(*module.split(".")[1:]).resolve()
    return any((source.parent / "__pycache__").glob(f"{name}.*.nbi"))


def compile_kernels(every: bool = False) -> list[str]:
    """Compiles what is not in the cache, with a word and a bar, and returns those modules; `every` also loads and tries all.

    Some are compiled as they are loaded, others at their first call: nothing is left that would be announced again.
    """
    import rbpf.kernels  # noqa: F401  (discards copies that are older than their sources)

    modules = kernel_modules()
    missing = [name for name in modules if not cached(name)]
    if missing:
        say(f"compiling {len(missing)} of {len(modules)} kernels: this takes some minutes and is done once …")
    work: list[Callable[[], object]] = [partial(import_module, name) for name in (modules if every else missing)]
    if work:
        work.append(_first_calls)
        with progress() as bar:
            report = bar("compiling" if missing else "trying the kernels")
            report(0, len(work))
            for done, part in enumerate(work, 1):
                part()
                report(done, len(work))
    return missing


def _first_calls() -> None:
    """Calls what is compiled at its first call, as the systems call it, on a few numbers."""
    import numpy as np

    from rbpf.motion.stereo_geometry import Matches
    from rbpf.motion.stereo_vo import estimate_motion
    from rbpf.runs.recordings import RobotRecording, filter_recording
    from rbpf.sensors.camera import Pinhole, RectifiedStereo
    from rbpf.sensors.features import CornerDetector
    from rbpf.sensors.patches.search import cut, search, warp
    from rbpf.systems.range_bearing.config import RangeBearingConfig
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    # A search for patches.
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (30, 40)).repeat(5, axis=0).repeat(5, axis=1).astype(np.uint8)
    px = CornerDetector().detect(image, 4).px
    windows = [window for place in px if (window := cut(image, place)) is not None]
    templates = warp(np.array(windows), np.tile(np.eye(2), (len(windows), 1, 1)))
    search(image, templates, px[: len(windows)], np.tile(4.0 * np.eye(2), (len(windows), 1, 1)))
    # The motion of a stereo pair.
    rig = RectifiedStereo(Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5), 0.12)
    before = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 5.0], (40, 3))
    z_prev, z_now = rig.project(before), rig.project(before + np.array([0.02, 0.0, 0.05]))
    estimate_motion(Matches.checked(rig, z_prev, z_now, np.eye(3), np.eye(3)), rng)
    # A robot's log.
    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(5, 20, False), Path(folder) / "log", 0)
        filter_recording(RobotRecording(Path(folder) / "log"), RangeBearingConfig(particles=10))
