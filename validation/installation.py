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
    found = []
    for name, extra, module, distribution, probe in _PROBES:
        try:
            said = probe(import_module(module))
            says = said if isinstance(said, str) else f"{distribution} {version(distribution)}"
            found.append(Part(name, True, not extra, says))
        except Exception as error:  # whatever a broken library raises as it is loaded
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            again = "install the package again: pip install --force-reinstall"
            remedy = f"pip install 'rbpf[{extra}]'" if extra else again
            found.append(Part(name, False, not extra, f"{reason}; {remedy}"))
    return found


def _compiler(numba: Any) -> str:
    folder = Path(numba.config.CACHE_DIR or Path(__file__).resolve().parents[1] / "sensors" / "__pycache__")
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


#: What it does, the extra that it comes with, module and distribution, and how it is tried once it is loaded.
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
