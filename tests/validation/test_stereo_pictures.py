"""What a stereo run keeps of each pair, and the frames that are drawn from it."""

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rbpf.runs.recordings import filter_pairs
from rbpf.runs.run import Run
from rbpf.systems.stereo.config import StereoConfig, TriggerConfig
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.validation.report.rerun import recording, write_rerun
from rbpf.validation.report.video import FEATURES, Caption, annotated_frames, draw_pair, drawn_size
from tests.systems.plane_sequences import CAMERA
from tests.systems.stereo_sequences import missing, pairs

CONFIG, COUNT, BAD = StereoConfig(particles=40, trigger=TriggerConfig(0.0, 0.0)), 8, 5


def sequence():
    return pairs(COUNT, lambda t, frame: missing(frame) if t == BAD else frame)


@pytest.fixture(scope="module")
def run() -> Run:
    return filter_pairs(sequence(), CONFIG)


def test_what_each_feature_was(run):
    """New ones in the first pair, candidates in the second, landmarks from the third on; as many as were counted."""
    kinds = [np.bincount(seen["kind"], minlength=4) for seen in run.log.all_observed()]
    assert len(kinds) == COUNT and [kind.sum() for kind in kinds] == run.log["features"].tolist()
    assert kinds[0][FeatureKind.NEW] > 5 and kinds[0][FeatureKind.LANDMARK] == kinds[0][FeatureKind.CANDIDATE] == 0
    assert kinds[1][FeatureKind.CANDIDATE] > 3 and kinds[1][FeatureKind.LANDMARK] == 0
    np.testing.assert_array_equal([k[FeatureKind.LANDMARK] for k in kinds], run.log["observed"])
    assert kinds[-1][FeatureKind.LANDMARK] > 5
    assert sum(k[FeatureKind.NEW] for k in kinds) == run.system.front_end.landmarks.manager.next_name
    assert kinds[BAD].sum() == 0


def test_between_updates_all_are_features():
    rare = filter_pairs(pairs(3), replace(CONFIG, trigger=TriggerConfig(9.0, 9.0)))
    kind = rare.log.observed(2)["kind"]
    assert (kind == FeatureKind.FEATURE).all() and len(kind) > 20


@pytest.mark.parametrize("kind", [FeatureKind.FEATURE, FeatureKind.CANDIDATE, FeatureKind.LANDMARK, FeatureKind.NEW])
def test_a_feature_is_drawn_where_it_is(kind):
    """A cross at the left pixel, and a line as long as the disparity, at twice the size, below the caption."""
    seen = {"z": np.array([[60.0, 40.0, 30.0]]), "kind": np.array([kind])}
    picture = draw_pair(np.zeros((90, 120), dtype=np.uint8), seen, Caption("pair 0", ""), (120, 90))
    assert picture.shape[:2] == drawn_size(120, 90)[::-1]
    rows, columns = np.nonzero((picture[24:] == FEATURES[kind][1]).all(axis=-1))
    assert abs(np.median(rows) - 80.5) <= 1.0
    assert abs(columns.min() - 60.5) <= 2.0 and 120 <= columns.max() <= 126


def test_frames_of_a_run(run):
    frames = list(annotated_frames(run))
    assert len(frames) == COUNT
    assert {frame.shape for frame in frames} == {(*drawn_size(CAMERA.width, CAMERA.height)[::-1], 3)}
    green = [int((frame[24:] == FEATURES[FeatureKind.LANDMARK][1]).all(axis=-1).sum()) for frame in frames]
    assert green[0] == green[1] == green[BAD] == 0 and green[-1] > 50
    red = [int(((frame[:24, :, 0] > 120) & (frame[:24, :, 1] < 70)).sum()) for frame in frames]
    assert red[BAD] > 20 and red[0] == 0


class Stream:
    """Keeps what is logged for the viewer."""

    def __init__(self) -> None:
        self.logged: dict[str, list[Any]] = {}

    def log(self, place: str, what: Any, static: bool = False) -> None:
        self.logged.setdefault(place, []).append(what)

    def set_time(self, name: str, **time: float) -> None:
        self.logged.setdefault(f"time/{name}", []).append(time)


@pytest.mark.slow
def test_features_in_the_recording(run, tmp_path, monkeypatch):
    """Every pair's features under what they were, half a pixel aside, and landmarks where the map has them."""
    rr = pytest.importorskip("rerun")
    stream = Stream()
    monkeypatch.setattr("rbpf.validation.report.rerun.recording", lambda *_: nullcontext((rr, stream)))
    write_rerun(run, tmp_path / "unused.rrd")
    logged = stream.logged
    assert len(logged["time/frame"]) == COUNT and len(logged["world/camera/image"]) == COUNT
    for kind, name in (
        (FeatureKind.LANDMARK, "landmark"),
        (FeatureKind.CANDIDATE, "candidate"),
        (FeatureKind.NEW, "new"),
        (FeatureKind.FEATURE, "feature"),
    ):
        pixels = logged[f"world/camera/image/{name}"]
        for seen, drawn in zip(run.log.all_observed(), pixels, strict=True):
            xy = np.array(drawn.positions.as_arrow_array().to_pylist()).reshape(-1, 2)
            np.testing.assert_allclose(xy, seen["z"][seen["kind"] == kind, :2] + 0.5, atol=1e-4)
    places = np.array(logged["world/seen"][-1].positions.as_arrow_array().to_pylist())
    mapped = run.system.map().mean
    nearest = np.linalg.norm(places[:, None] - mapped, axis=2).min(axis=1)
    assert len(places) > 5 and np.median(nearest) < 0.02


def test_a_recording_that_fails_leaves_nothing(tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(ZeroDivisionError), recording(tmp_path / "x.rrd", "x"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
