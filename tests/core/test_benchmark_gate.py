"""The committed baseline of the benchmarks: what a run is told, and what recording some rows keeps."""

import pytest

from benchmarks.gate import regressions, write_baseline
from benchmarks.rows import Row
from benchmarks.stereo_step import Drive


def row(name: str, ratio: float, higher: bool = True) -> Row:
    return Row(name, 1.0, "ms", "peer", 1.0, ratio, higher=higher)


def test_what_got_worse_or_has_no_baseline_is_told(tmp_path):
    path = tmp_path / "baseline.json"
    write_baseline(path, [row("fast", 2.0), row("small", 2.0, higher=False), row("left", 1.0)], partial=False)
    better = [row("fast", 9.0), row("small", 0.1, higher=False)]
    assert regressions(path, better, partial=True) == []
    assert regressions(path, better, partial=False) == ["left: no figure in this run"]
    worse = regressions(path, [row("fast", 1.0), row("small", 4.0, higher=False), row("new", 1.0)], partial=True)
    assert [sentence.split(":")[0] for sentence in worse] == ["new", "fast", "small"]
    assert "no baseline" in worse[0] and "-50%" in worse[1] and "+100%" in worse[2]


def test_recording_some_rows_keeps_the_others(tmp_path):
    path = tmp_path / "baseline.json"
    write_baseline(path, [row("one", 1.0), row("other", 2.0)], partial=False)
    write_baseline(path, [row("one", 3.0)], partial=True)
    assert regressions(path, [row("one", 3.0), row("other", 2.0)], partial=False) == []
    assert regressions(path, [row("one", 1.0)], partial=True) != []
    write_baseline(path, [row("one", 3.0)], partial=False)
    assert regressions(path, [row("other", 2.0)], partial=True) == ["other: no baseline, record one"]


@pytest.mark.slow
def test_two_cameras_are_driven_as_their_benchmarks_do():
    drive = Drive(100, 2)
    drive()
    assert (drive.sensor.ids >= 0).sum() > 10
