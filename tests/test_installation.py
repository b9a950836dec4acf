"""Wheel and source distribution hold the whole package, and it works from where nothing of this folder is."""

import importlib.util
import os
import pkgutil
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import rbpf
from rbpf.cli import main
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"rbpf": "rbpf", **{f"rbpf/{name}": name for name in ("sensors", "motion", "maps", "validation")}}
"""Where the package's folders are in a distribution, and in the project."""

LEFT_BEHIND = {".pyc", ".nbi", ".nbc"}


def package_files() -> set[str]:
    """Every file of the package, by its name in a distribution."""
    return {
        f"{inside}/{path.relative_to(ROOT / folder)}"
        for inside, folder in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix not in LEFT_BEHIND and "__pycache__" not in path.parts
    }


def distribution(folder: Path) -> Path:
    """Wheel and source distribution as `make dist` builds them, in a copy, so that nothing is left in the project."""
    listed = run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT).split("\0")
    for name in filter(None, listed):
        source, target = ROOT / name, folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(os.readlink(source))
        elif source.is_file():
            target.write_bytes(source.read_bytes())
    # The time of the commit is asked of the project; what is installed is that of these tests.
    git = run(["git", "rev-parse", "--absolute-git-dir"], cwd=ROOT).strip()
    run(["make", "-C", str(folder), "-o", ".venv/stamp", "dist", f"BIN={Path(sys.executable).parent}"],
        env={**os.environ, "GIT_DIR": git, "MAKEFLAGS": ""})  # fmt: skip
    return folder / "dist"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with both."""
    return distribution(tmp_path_factory.mktemp("source") / "rbpf")


def run(command: list[str], **options) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@pytest.mark.slow
def test_wheel_and_source_distribution_hold_every_file_of_the_package(built):
    (wheel,), (archive,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with tarfile.open(archive) as files:
        source = {member.name.split("/", 1)[1] for member in files.getmembers() if member.isfile()}
    for names in (set(zipfile.ZipFile(wheel).namelist()), source):
        assert {name for name in names if name.startswith("rbpf/")} == package_files()
    assert {"pyproject.toml", "README.md", "LICENSE"} <= source


@pytest.mark.slow
def test_a_commit_is_always_built_to_the_same_bytes(built, tmp_path):
    """In another folder, at another time, by somebody whose new files are nobody else's to read."""
    before = os.umask(0o077)
    try:
        again = distribution(tmp_path / "elsewhere")
    finally:
        os.umask(before)
    assert {path.name: path.read_bytes() for path in built.iterdir()} == {
        path.name: path.read_bytes() for path in again.iterdir()
    }


def hand_over_compiled_kernels(site: Path) -> None:
    """Numba takes a compiled copy for one of a source with the same time and size; compiling anew would take minutes."""
    for inside, folder in FOLDERS.items():
        for source in (ROOT / folder).rglob("*.py"):
            copy = site / inside / source.relative_to(ROOT / folder)
            if copy.is_file():
                shutil.copystat(source, copy)  # of all of them: copies older than any kernel's source are discarded
        for path in (ROOT / folder).rglob("*.nb?"):
            place = site / inside / path.relative_to(ROOT / folder)
            place.parent.mkdir(exist_ok=True)
            shutil.copy2(path, place)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, plain_pictures):
    """A run to report on."""
    folder = tmp_path_factory.mktemp("finished")
    simulate_robot(RobotWorld(steps=8, landmarks=10), folder / "log", seed=0)
    arguments = ["--out", str(folder / "run"), "--particles", "5", "--no-batch"]
    assert main(["run", "range-bearing", str(folder / "log"), *arguments]) == 0
    return folder / "run"


@pytest.mark.slow
def test_an_installed_package_simulates_and_reports(built, finished, tmp_path):
    """In an environment of its own, with the dependencies of this one; the wheel was built from the source distribution."""
    (distribution,) = built.glob("*.whl")
    venv.create(tmp_path / "environment", with_pip=False)
    python = tmp_path / "environment" / "bin" / "python"
    (site,) = (tmp_path / "environment" / "lib").glob("python*/site-packages")
    run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
         "--no-compile", "--target", str(site), str(distribution)])  # fmt: skip
    hand_over_compiled_kernels(site)
    lower = [path for path in sys.path if path.endswith("site-packages")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *lower])}
    where = run([str(python), "-c", "import rbpf; print(rbpf.__file__)"], cwd=tmp_path, env=environment)
    assert Path(where.strip()) == site / "rbpf" / "__init__.py"
    rbpf = [str(python), "-m", "rbpf"]
    run([*rbpf, "simulate", "range-bearing", "--out", "log", "--steps", "8"], cwd=tmp_path, env=environment)
    assert (tmp_path / "log" / "odometry.csv").is_file()
    report = finished / "report.html"
    report.unlink()
    run([*rbpf, "report", str(finished)], cwd=tmp_path, env=environment)
    assert report.stat().st_size > 10_000


# Importing the package imports hardly anything else, and needs neither the optimisers nor image processing.

HEAVY = ("gtsam", "pycolmap", "cv2")
FREE_TO_NEED_THEM = ("rbpf.validation", "rbpf.cli")

IMPORTED = """
import sys
before = set(sys.modules)
{statement}
top = {{name.split(".")[0] for name in set(sys.modules) - before}}
print(*sorted(name for name in top if name not in sys.stdlib_module_names and not name.startswith("_")))
"""

IMPORT_WITHOUT = """
import importlib, sys
for absent in {absent!r}:
    sys.modules[absent] = None
for name in {modules!r}:
    importlib.import_module(name)
"""


def imported_by(statement: str) -> set[str]:
    """Packages outside of Python's own library that a statement imports."""
    return set(run([sys.executable, "-c", IMPORTED.format(statement=statement)]).split())


def modules_that_need_no_heavy_import() -> list[str]:
    found = [module.name for module in pkgutil.walk_packages(rbpf.__path__, "rbpf.", onerror=raise_it)]
    return [name for name in ["rbpf", *found] if not name.startswith(FREE_TO_NEED_THEM)]


def raise_it(name: str) -> None:
    raise ImportError(name)


def test_importing_the_package_imports_hardly_anything_else():
    """Which is why it takes milliseconds, on a machine however busy."""
    assert imported_by("import rbpf") == {"rbpf", "lazy_loader"}


def test_the_command_line_keeps_blas_on_one_thread_before_numpy_is_there():
    """Which reads it as it is imported; results are the same bytes whatever was set."""
    early = "import sys, tyro; assert 'numpy' not in sys.modules"
    said = "import os, rbpf.cli; print(os.environ['OPENBLAS_NUM_THREADS'])"
    without = "import os; os.environ.pop('OPENBLAS_NUM_THREADS', None)"
    given = "import os; os.environ['OPENBLAS_NUM_THREADS'] = '3'"
    for before, threads in ((f"{without}\n{early}", "1"), (given, "1")):
        assert run([sys.executable, "-c", f"{before}\n{said}"]).strip() == threads


@pytest.mark.slow
def test_the_public_names_need_neither_pictures_nor_what_only_tests_use():
    unwanted = {"matplotlib", "PIL", "rich", "tyro", "joblib", "jaxtyping", "pytest", "rerun", *HEAVY}
    assert not imported_by("from rbpf import *") & unwanted


@pytest.mark.slow
def test_everything_but_validation_imports_without_optimisers_and_image_processing():
    modules = modules_that_need_no_heavy_import()
    assert {"rbpf.sensors", "rbpf.motion", "rbpf.maps", "rbpf.systems"} <= set(modules)
    run([sys.executable, "-c", IMPORT_WITHOUT.format(absent=HEAVY, modules=modules)])


def test_heavy_imports_are_there_to_be_blocked():
    for name in HEAVY:
        assert importlib.util.find_spec(name) is not None
