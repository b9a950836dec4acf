"""Importing the package is quick, and needs neither the optimisers nor image processing."""

import importlib.util
import pkgutil
import subprocess
import sys

import rbpf

LIMIT_S = 0.5
NUMPY_ALONE_S = 0.15  # what `import numpy` takes on an idle machine
HEAVY = ("gtsam", "pycolmap", "cv2")
FREE_TO_NEED_THEM = ("rbpf.validation", "rbpf.cli")

TIME_OF_IMPORT = """
import time
start = time.perf_counter()
import {module}
print(time.perf_counter() - start)
"""

IMPORT_WITHOUT = """
import importlib, sys
for absent in {absent!r}:
    sys.modules[absent] = None
for name in {modules!r}:
    importlib.import_module(name)
"""


def run_python(source: str) -> str:
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def seconds_to_import(module: str) -> float:
    return min(float(run_python(TIME_OF_IMPORT.format(module=module))) for _ in range(3))


def modules_that_need_no_heavy_import() -> list[str]:
    found = [module.name for module in pkgutil.walk_packages(rbpf.__path__, "rbpf.", onerror=raise_it)]
    return [name for name in ["rbpf", *found] if not name.startswith(FREE_TO_NEED_THEM)]


def raise_it(name: str) -> None:
    raise ImportError(name)


def test_import_takes_less_than_half_a_second():
    taken = seconds_to_import("rbpf")
    slowdown = 1.0 if taken < LIMIT_S else max(1.0, seconds_to_import("numpy") / NUMPY_ALONE_S)
    assert taken < LIMIT_S * slowdown


def test_everything_but_validation_imports_without_optimisers_and_image_processing():
    modules = modules_that_need_no_heavy_import()
    assert {"rbpf.sensors", "rbpf.motion", "rbpf.maps", "rbpf.systems"} <= set(modules)
    run_python(IMPORT_WITHOUT.format(absent=HEAVY, modules=modules))


def test_heavy_imports_are_there_to_be_blocked():
    for name in HEAVY:
        assert importlib.util.find_spec(name) is not None
