"""Views, annotated frames and sightings of runs over images."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.runs.plots import Views
from rbpf.runs.recordings import filter_images
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers import open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.report.video import FOUND, MISSED, RAY, Caption, draw_search, drawn_size, frame_rate, is_complete
from rbpf.validation.simulation.desk_and_room import OVER_DESK, TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "desk"
    camera = Pinhole(240, 180, 190.0, 190.0, 119.5, 89.5)
    world = TexturedDesk(frames=40, texel_m=0.003, hand=replace(OVER_DESK, speed_m_s=0.6, start_s=0.2))
    simulate_images(world, Imaging(noise_std=1.0), camera, folder, seed=1)
    return filter_images(open_images(folder), MonoConfig(particles=8), read_known_points(folder / "known_points.csv"))


def found(sighting):
    return np.isfinite(sighting["px"]).all(axis=1)


def is_ray(sighting):
    return np.isfinite(sighting["line"]).all(axis=(1, 2))


def test_rays_are_found_on_their_epipolar_lines(run):
    distances = []
    for sighting in run.log.all_observed()[20:]:
        rows = is_ray(sighting) & found(sighting)
        start, end = np.moveaxis(sighting["line"][rows], 1, 0)
        along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
        offset = sighting["px"][rows] - start
        distances += np.abs(offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]).tolist()
    assert len(distances) > 20
    assert np.median(distances) < 1.0


def test_places_that_were_seen_lie_in_the_known_points_world(run):
    sighting = run.log.all_observed()[-1]
    known = run.system.known_points
    members = found(sighting) & (sighting["features"] < known.names.size)
    assert members.any()
    place = sighting["position"][members, :3] / sighting["position"][members, 3:]
    assert np.abs(place - known.positions[sighting["features"][members]]).max() < 0.02


def test_the_map_covers_the_desk_within_its_own_uncertainty(run):
    mapped = run.system.map()
    new = ~mapped.is_ray() & (mapped.ids >= run.system.known_points.names.size)
    height, std = mapped.mean[new, 2], np.sqrt(mapped.cov[new, 2, 2])
    assert new.sum() >= 5
    assert (height + 4.0 * std > -0.005).all()  # nothing on the desk lies below its top
    assert (height - 4.0 * std < 0.255).all()  # nor above its highest thing


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
