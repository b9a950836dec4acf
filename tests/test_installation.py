"""Wheel and source distribution hold the whole package, and it works from where nothing of this folder is."""

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

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
def test_the_wheel_holds_every_file_of_the_package(built):
    (wheel,) = built.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("rbpf/")}
    assert names == package_files()


@pytest.mark.slow
def test_the_source_distribution_holds_every_file_of_the_package(built):
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as files:
        names = {member.name.split("/", 1)[1] for member in files.getmembers() if member.isfile()}
    assert {name for name in names if name.startswith("rbpf/")} == package_files()
    assert {"pyproject.toml", "README.md", "LICENSE"} <= names


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
