"""Views, annotated frames and sightings of runs over images."""

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.runs.plots import Views
from rbpf.validation.report.video import FOUND, MISSED, RAY, Caption, draw_search, drawn_size, frame_rate, is_complete


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


def test_a_frame_shows_hits_misses_and_lines():
    sighting = {
        "mean": np.array([[40.0, 30.0], [80.0, 40.0]]),
        "cov": np.tile(4.0 * np.eye(2), (2, 1, 1)),
        "px": np.array([[41.0, 30.0], [np.nan, np.nan]]),
        "line": np.array([[[np.nan] * 2] * 2, [[-1e9, 40.0], [1e9, 40.0]]]),
        "started_px": np.zeros((0, 2)),
    }
    image = np.full((90, 120), 128, dtype=np.uint8)
    picture = draw_search(image, sighting, Caption("frame 0", ""), (120, 90))
    assert picture.shape[:2] == drawn_size(120, 90)[::-1]
    below = picture[30:]
    counts = [int((below == colour).all(axis=-1).sum()) for colour in (FOUND, MISSED, RAY)]
    assert min(counts[:2]) > 30 and counts[2] > 200


def test_equal_stamps_still_have_a_rate():
    assert frame_rate(np.arange(5) * 33_333_333) == pytest.approx(30.0, abs=0.01)
    assert frame_rate(np.zeros(5, dtype=np.int64)) == 1.0
    assert frame_rate(np.array([0])) == 1.0


def test_a_video_that_the_encoder_could_not_finish_is_seen(tmp_path):
    import imageio_ffmpeg

    path = tmp_path / "a.mp4"
    encoder = imageio_ffmpeg.write_frames(str(path), (64, 48), ffmpeg_log_level="error")
    encoder.send(None)
    for grey in (0, 100, 200):
        encoder.send(np.full((48, 64, 3), grey, np.uint8))
    encoder.close()
    data = path.read_bytes()
    assert is_complete(path)
    for length in (0, 5, 40, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        assert not is_complete(path)
