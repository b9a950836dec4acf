"""What runs over images keep of each frame, the frames, views and videos that are drawn of it, and names of videos."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.plots import Views
from rbpf.runs.recordings import filter_opened, open_pairs
from rbpf.runs.run import Run
from rbpf.sensors.readers.images.video import opened
from rbpf.systems.stereo.config import StereoConfig, TriggerConfig
from rbpf.systems.stereo.landmarks import FeatureKind
from rbpf.validation.report.live import recording
from rbpf.validation.report.video import FEATURES, annotated_frames, drawn_size, frame_rate, write_video
from tests.cli.sequences import full_disk
from tests.systems.plane_sequences import CAMERA
from tests.systems.stereo_sequences import missing, pairs

CONFIG, COUNT, BAD = replace(StereoConfig.s05(), particles=40, trigger=TriggerConfig(0.0, 0.0)), 8, 5


def sequence():
    return pairs(COUNT, lambda t, frame: missing(frame) if t == BAD else frame)


@pytest.fixture(scope="module")
def run() -> Run:
    return filter_opened(open_pairs(sequence(), CONFIG))


def test_what_each_feature_was(run):
    """New ones in the first pair, candidates in the second, landmarks from the third on; as many as were counted."""
    kinds = [np.bincount(seen["kind"], minlength=4) for seen in map(run.log.observed, range(len(run.log)))]
    assert len(kinds) == COUNT and [kind.sum() for kind in kinds] == run.log["features"].tolist()
    assert kinds[0][FeatureKind.NEW] > 5 and kinds[0][FeatureKind.LANDMARK] == kinds[0][FeatureKind.CANDIDATE] == 0
    assert kinds[1][FeatureKind.CANDIDATE] > 3 and kinds[1][FeatureKind.LANDMARK] == 0
    np.testing.assert_array_equal([k[FeatureKind.LANDMARK] for k in kinds], run.log["observed"])
    assert kinds[-1][FeatureKind.LANDMARK] > 5
    assert sum(k[FeatureKind.NEW] for k in kinds) == run.system.front_end.landmarks.manager.next_name
    assert kinds[BAD].sum() == 0


def test_frames_of_a_run(run):
    frames = list(annotated_frames(run))
    assert len(frames) == COUNT
    assert {frame.shape for frame in frames} == {(*drawn_size(CAMERA.width, CAMERA.height)[::-1], 3)}
    green = [int((frame[24:] == FEATURES[FeatureKind.LANDMARK][1]).all(axis=-1).sum()) for frame in frames]
    assert green[0] == green[1] == green[BAD] == 0 and green[-1] > 50
    red = [int(((frame[:24, :, 0] > 120) & (frame[:24, :, 1] < 70)).sum()) for frame in frames]
    assert red[BAD] > 20 and red[0] == 0


@pytest.mark.slow
def test_a_recording_that_fails_leaves_nothing(tmp_path):
    pytest.importorskip("rerun")
    with pytest.raises(ZeroDivisionError), recording(tmp_path / "x.rrd", "x"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("vertical", "down", "tilt_deg"), [(2, False, 50.0), (2, False, 0.0), (1, True, 10.0), (0, False, 30.0)]
)
def test_views_find_the_vertical(vertical, down, tilt_deg):
    up = np.eye(3)[vertical] * (-1.0 if down else 1.0)
    first = np.eye(3)[(vertical + 1) % 3]
    poses = []
    for heading in np.deg2rad(np.linspace(-25.0, 25.0, 9)):
        ahead = np.cos(heading) * first + np.sin(heading) * np.cross(up, first)
        right = np.cross(ahead, up)
        tilt = np.deg2rad(tilt_deg)
        forward = np.cos(tilt) * ahead - np.sin(tilt) * up
        poses.append(np.column_stack([right, np.cross(forward, right), forward, np.zeros(3)]))
    views = Views.of_camera(SE3.from_matrix(np.array(poses)))
    assert views.side[1] == vertical and views.down == down
    a, b = np.eye(3)[list(views.top)]
    assert np.allclose(np.cross(a, b), up)


def test_equal_stamps_still_have_a_rate():
    assert frame_rate(np.arange(5) * 33_333_333) == pytest.approx(30.0, abs=0.01)
    assert frame_rate(np.zeros(5, dtype=np.int64)) == 1.0
    assert frame_rate(np.array([0])) == 1.0


PICTURES = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8)
STAMPS = 100_000_000 * np.arange(4)


@pytest.mark.parametrize("most_bytes", [0, 40, 4000])
def test_a_video_that_the_encoder_could_not_finish_is_none(tmp_path, most_bytes):
    with full_disk(most_bytes), pytest.raises(InputError, match=r"cannot be written: (the encoder could not|Broken)"):
        write_video(iter(PICTURES), STAMPS, tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["12:30.mp4", "-x.mp4", "http:x.mp4", "file:base.mp4", "walk%03d.mp4"])
def test_such_a_video_is_written_and_read(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = type(tmp_path)(name)
    write_video(iter(PICTURES), STAMPS, path)
    assert [place.name for place in tmp_path.iterdir()] == [name]
    with opened(path) as capture:
        found, image = capture.read()
    assert found and image.shape == (64, 64, 3)


def test_another_protocol_is_not_followed_and_a_name_that_is_no_text_is_refused(tmp_path):
    # A playlist that names another file.
    write_video(iter(PICTURES), STAMPS, tmp_path / "base.mp4")
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/base.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputError), opened(tmp_path / "list.mp4"):
        pass
    with pytest.raises(InputError, match="must be text in UTF-8"), opened(tmp_path / "walk\udcff.mp4"):
        pass
