"""`rbpf doctor` and `rbpf completion`: what is installed and which parts of it work here, and the shell's completion."""

import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import tyro

from rbpf import __version__
from rbpf.cli.compiling import cached, compile_kernels, kernel_modules
from rbpf.cli.options import Printed
from rbpf.cli.showing import answer, table
from rbpf.errors import InputError

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, kw_only=True)
class Doctor(Printed):
    """Show installed versions and which parts work on this machine; compile the kernels."""

    compile: bool = True  #: compile the kernels now, instead of at the first run.

    def __call__(self) -> None:
        from importlib.metadata import PackageNotFoundError, requires, version

        found = {
            "rbpf": __version__,
            "installed_in": str(_ROOT),
            "python": sys.version.split()[0],
            "system": f"{platform.system()} {platform.release()}",
            "machine": platform.machine(),
            "cores": os.cpu_count() or 1,
        }
        # Versions of the package's requirements; None for missing ones.
        required = [
            re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in requires("rbpf") or () if "extra ==" not in line
        ]
        libraries: dict[str, str | None] = dict.fromkeys(required)
        for name in required:
            with suppress(PackageNotFoundError):
                libraries[name] = version(name)
        # Whether each part works, and its version or path; else the reason, and what to do.
        parts: list[dict[str, Any]] = []
        for name, extra, module, distribution, probe in _PROBES:
            part = {"name": name, "works": True, "needed": not extra}
            try:
                said = probe(import_module(module))
                part["says"] = said if isinstance(said, str) else f"{distribution} {version(distribution)}"
            except Exception as error:  # a broken library may raise anything on import
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                again = "install the package again: pip install --force-reinstall"
                remedy = f"pip install 'rbpf[{extra}]'" if extra else again
                part |= {"works": False, "says": f"{reason}; {remedy}"}
            parts.append(part)
        modules, compiled = kernel_modules(), dict[str, float]()
        if self.compile:
            started = time.perf_counter()
            compile_kernels(every=True)
            compiled = {"kernels_seconds": round(time.perf_counter() - started, 1)}
        missing = [name for name in modules if not cached(name)]
        failing = [part for part in parts if not part["works"]]
        broken = ", ".join(part["name"] for part in failing if part["needed"])
        entries = {
            **found,
            "libraries": libraries,
            "parts": parts,
            **compiled,
            "kernels_missing": missing,
            "works": not broken,
        }
        fails = {True: "BROKEN", False: "not installed"}
        lines = {p["name"]: f"{'works' if p['works'] else fails[p['needed']]}: {p['says']}" for p in parts}
        known = {name: number or "missing" for name, number in libraries.items()}
        kernels = f"{len(modules) - len(missing)} of {len(modules)} compiled"
        # The result first, and the next step.
        absent = ", ".join(part["name"] for part in failing)
        optional = f"; not installed, and only needed for what its name says: {absent}" if absent else ""
        result = f"{broken}: needed, and broken here" if broken else f"all that every run needs works{optional}"
        todo = "what to do stands in its line" if broken else "to begin: rbpf demo"
        answer(entries, self.json, result, *table({**found, **known, **lines, "kernels": kernels}, 26), todo)
        if broken:
            raise InputError(f"{result}; see above")


def _compiler(numba: Any) -> str:
    folder = Path(numba.config.CACHE_DIR or _ROOT / "sensors" / "__pycache__")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to, kernels are compiled anew: set NUMBA_CACHE_DIR")
    return f"Numba {numba.__version__}, {numba.config.NUMBA_NUM_THREADS} threads, cache writable"


def _images(cv2: Any) -> str:
    cv2.SIFT_create()
    names = [cv2.videoio_registry.getBackendName(key) for key in cv2.videoio_registry.getBackends()]
    if "FFMPEG" not in names:
        raise RuntimeError("OpenCV was built without FFmpeg and reads no video")
    return f"OpenCV {cv2.__version__}, with SIFT and video"


def _gtsam(gtsam: Any) -> None:
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    start.insert(0, gtsam.Pose3())
    gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()


def _ffmpeg(imageio_ffmpeg: Any) -> str:
    path: str = imageio_ffmpeg.get_ffmpeg_exe()
    subprocess.run([path, "-version"], check=True, capture_output=True, timeout=30)
    return path


#: Purpose, extra, module and distribution, and test after import.
_PROBES: tuple[tuple[str, str, str, str, Callable[[Any], Any]], ...] = (
    ("compiled kernels", "", "numba", "numba", _compiler),
    ("images and video", "", "cv2", "opencv-python-headless", _images),
    ("batch optimum", "", "gtsam", "GTSAM", _gtsam),
    ("reconstruction", "", "pycolmap", "pycolmap", lambda pycolmap: pycolmap.Reconstruction()),
    ("annotated video", "", "imageio_ffmpeg", "imageio-ffmpeg", _ffmpeg),
    ("pictures", "", "matplotlib.figure", "Matplotlib", lambda figure: figure.Figure().canvas.draw()),
    ("Rerun recordings", "viewing", "rerun", "rerun-sdk", lambda _: None),
    ("ROS bags", "bags", "rosbags.rosbag2", "rosbags", lambda _: None),
    ("sweeps on a cluster", "cluster", "distributed", "Dask", lambda _: None),
)


#: The last line for zsh is for a file in its `fpath`; evaluated, it would not register the completion.
_ZSH = (
    '\n_tyro_rbpf "$@"\n',
    '\nif [ "$funcstack[1]" = "_rbpf" ]; then _tyro_rbpf "$@"; else compdef _tyro_rbpf rbpf; fi\n',
)


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Print a script that completes the commands and options of rbpf in a shell: eval "$(rbpf completion bash)"."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]  #: the shell.

    def __call__(self) -> None:
        from rbpf.cli import APP, PROGRAM

        printed = StringIO()
        with suppress(SystemExit), redirect_stdout(printed):
            APP.call(["--tyro-print-completion", self.shell], PROGRAM)
        sys.stdout.write(printed.getvalue().replace(*_ZSH))
