"""What is installed, in which versions, and which parts of it work here."""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, NamedTuple

from rbpf import __version__

TIMEOUT_S = 30


class Part(NamedTuple):
    """Something that the program does with a library: whether it works, and whether every installation needs it.

    `says` is a version or path; where it does not work, why, and what to do.
    """

    name: str
    works: bool
    needed: bool
    says: str


def machine() -> dict[str, Any]:
    """Python, system, processor."""
    return {
        "rbpf": __version__,
        "installed_in": str(Path(__file__).resolve().parents[1]),
        "python": sys.version.split()[0],
        "system": f"{platform.system()} {platform.release()}",
        "machine": platform.machine(),
        "cores": os.cpu_count() or 1,
    }


def versions() -> dict[str, str | None]:
    """Of what the package requires; None for what is missing."""
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in requires("rbpf") or () if "extra ==" not in line]
    found: dict[str, str | None] = dict.fromkeys(names)
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def parts() -> list[Part]:
    """Tries every part."""
    return [_tried(*probe) for probe in _PROBES]


def _tried(name: str, extra: str, probe: Callable[[], str]) -> Part:
    try:
        return Part(name, True, not extra, probe())
    except Exception as error:  # whatever a broken library raises as it is loaded
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        remedy = f"pip install 'rbpf[{extra}]'" if extra else "install the package again: pip install --force-reinstall"
        return Part(name, False, not extra, f"{reason}; {remedy}")


def _compiler() -> str:
    numba = import_module("numba")
    folder = Path(numba.config.CACHE_DIR or Path(__file__).resolve().parents[1] / "sensors" / "__pycache__")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written to, kernels are compiled anew: set NUMBA_CACHE_DIR")
    return f"Numba {numba.__version__}, {numba.config.NUMBA_NUM_THREADS} threads, cache writable"


def _images() -> str:
    cv2 = import_module("cv2")
    cv2.SIFT_create()
    names = [cv2.videoio_registry.getBackendName(key) for key in cv2.videoio_registry.getBackends()]
    if "FFMPEG" not in names:
        raise RuntimeError("OpenCV was built without FFmpeg and reads no video")
    return f"OpenCV {cv2.__version__}, with SIFT and video"


def _gtsam() -> None:
    gtsam = import_module("gtsam")
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    start.insert(0, gtsam.Pose3())
    gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()


def _ffmpeg() -> str:
    path = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    subprocess.run([path, "-version"], check=True, capture_output=True, timeout=TIMEOUT_S)
    return path


def _loaded(name: str, distribution: str, probe: Callable[[], object]) -> Callable[[], str]:
    """A probe that says the version of a distribution."""

    def say() -> str:
        probe()
        return f"{name} {version(distribution)}"

    return say


def _bags() -> None:
    for part in ("rosbag1", "rosbag2"):
        import_module(f"rosbags.{part}")


_PROBES: tuple[tuple[str, str, Callable[[], str]], ...] = (
    ("compiled kernels", "", _compiler),
    ("images and video", "", _images),
    ("batch optimum", "", _loaded("GTSAM", "gtsam", _gtsam)),
    ("reconstruction", "", _loaded("pycolmap", "pycolmap", lambda: import_module("pycolmap").Reconstruction())),
    ("annotated video", "", _ffmpeg),
    (
        "pictures",
        "",
        _loaded("Matplotlib", "matplotlib", lambda: import_module("matplotlib.figure").Figure().canvas.draw()),
    ),
    ("Rerun recordings", "viewing", _loaded("rerun-sdk", "rerun-sdk", lambda: import_module("rerun"))),
    ("ROS bags", "bags", _loaded("rosbags", "rosbags", _bags)),
    ("sweeps on a cluster", "cluster", _loaded("Dask", "dask", lambda: import_module("distributed"))),
)
"""What it does, the extra that it comes with, how it is tried."""
