"""Fixtures and markers shared by all tests."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# For the processes that xdist starts: two of them, each with as many threads as cores, wait for one another. The small
# matrices of the tests gain nothing from threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numpy as np
import pytest

from tests.shapes import switch, watch

if os.environ.get("RBPF_SHAPES") != "0":
    watch()

gc.set_threshold(10_000, 20, 20)  # by default, looking for garbage takes a twelfth of the time

COUNTED = {"cli", "cli_calibrate", "cli_manners", "cli_mono", "cli_stereo", "export", "gtsam_ba", "loader_fuzz"}
COUNTED |= {"gtsam_ba_camera_start", "model_comparison", "mono_joint", "relocalisation", "stereo_slam", "sweep"}
NOT_COUNTED = {"accuracy", "camera_models", "compiled", "descriptors", "estimate", "grid", "kalman_limit", "layout"}
NOT_COUNTED |= {"mono_features", "patches", "refinement", "resampling", "resection", "simulation_robots"}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Counts tests that run lines which no others run; the same lines a thousand times take half as much time again."""
    if config.pluginmanager.hasplugin("pytest_cov"):
        for item in items:
            is_slow = any(item.get_closest_marker(name) for name in ("slow", "real_data"))
            name = item.path.stem.removeprefix("test_")
            if name not in COUNTED if is_slow else name in NOT_COUNTED:
                item.add_marker("no_cover")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: `RBPF_DATA`, by default `../shared/data` from the project's root."""
    folder = Path(os.environ.get("RBPF_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set RBPF_DATA to the folder that holds them")
    return folder


@pytest.fixture(autouse=True)
def next_test() -> None:
    """Shapes are checked anew in each test."""
    switch.test += 1


@pytest.fixture
def rng() -> np.random.Generator:
    """Begun anew in each test."""
    return np.random.default_rng(2005)


@pytest.fixture
def unchecked_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that hand over arrays of a wrong shape, and want to hear of it from the program."""
    monkeypatch.setattr(switch, "on", False)


@pytest.fixture(scope="module")
def plain_pictures() -> Iterator[None]:
    """Pictures are small, without ticks and words, and painted once, not as vectors again: in a tenth of the time.
    They still depend on what they show, so that runs can be compared by bytes; it is not for pictures that are looked at."""
    with pytest.MonkeyPatch.context() as patch:
        paint_plainly(patch)
        yield


def paint_plainly(patch: pytest.MonkeyPatch) -> None:
    """See `plain_pictures`; for a process of one's own."""
    from matplotlib.figure import Figure

    savefig = Figure.savefig

    def plain(figure: Figure, path: Path, **options: Any) -> None:
        figure.set_layout_engine("none")
        for axes in figure.axes:
            axes.set_axis_off()
            axes.set_title("")
            if (legend := axes.get_legend()) is not None:
                legend.remove()
        kept = {name: options.get(name) for name in ("format", "metadata")}
        path.write_bytes(b"%PDF") if kept["format"] == "pdf" else savefig(figure, path, dpi=30, **kept)

    patch.setattr(Figure, "savefig", plain)


@pytest.fixture(scope="module")
def drawn_once(plain_pictures: None) -> Iterator[None]:
    """Of runs that leave files of the same names the first is drawn; the others have copies of its pictures."""
    from rbpf.runs.plots import draw_run

    def draw(found: Any) -> None:
        kind = (found.system, *sorted(path.name for path in found.folder.iterdir()))
        if kind not in drawn:
            drawn[kind] = {name: (found.folder / name).read_bytes() for name in draw_run(found)}
        for name, content in drawn[kind].items():
            (found.folder / name).write_bytes(content)

    drawn: dict[tuple[str, ...], dict[str, bytes]] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rbpf.validation.finish.draw_run", draw)
        yield


@pytest.fixture(scope="module")
def keypoints_once() -> Iterator[None]:
    """In an image that one of the module's tests has seen, keypoints are not looked for again."""
    from rbpf.sensors.features import Features, Sift, SiftConfig

    extract, known = Sift.extract, dict[tuple[SiftConfig, bytes], Features]()

    def once(sift: Sift, image: np.ndarray) -> Features:
        key = sift.config, image.tobytes()
        if key not in known:
            known[key] = extract(sift, image)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sift, "extract", once)
        yield
