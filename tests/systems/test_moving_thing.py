"""A thing that moves through the view: what is new on it has to prove itself before it tells where the camera is."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.image_faults import cover_view
from rbpf.core.models import Part
from rbpf.runs.trajectory import Trajectory
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.readers.images import open_images, read_known_points
from rbpf.systems.mono.config import MonoConfig, SearchConfig
from rbpf.systems.mono.video import run_images
from rbpf.validation.metrics.mono_scores import score_path
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from tests.systems.mono_logs import SMALL
from tests.systems.plane_sequences import known_points, sequence

CAMERA = Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
FIRST, COUNT, FRAMES = 60, 60, 130
BLIND = MonoConfig(search=SearchConfig(trusted_fraction=0.0))


@pytest.mark.slow
def test_a_third_of_the_view_moves_and_the_camera_is_not_taken_along(tmp_path):
    """It crosses the view in two seconds; features on it are taken for near ones at rest, if they may tell at once."""
    simulate_images(TexturedDesk(frames=150, texel_m=0.003), Imaging(), CAMERA, tmp_path / "desk", seed=1)
    recording = open_images(tmp_path / "desk")
    known = read_known_points(tmp_path / "desk" / "known_points.csv")
    damaged = cover_view(1 / 3, FIRST, COUNT)(recording)
    worst = {}
    for name, config in (("trusting", BLIND), ("doubting", MonoConfig())):
        runs = [run_images(damaged, replace(config, seed=seed), known) for seed in (0, 1)]
        worst[name] = max(
            score_path(recording.truth, Trajectory(run.stamps_ns, run.world_from_camera), "none")[
                "path_rmse_m"
            ]
            for run in runs
        )
    assert worst["doubting"] < 0.03
    assert worst["trusting"] > 2.0 * worst["doubting"]


def test_what_is_often_missed_only_updates_the_map():
    run = run_images(sequence(12), SMALL, known_points())
    sensor, belief = run.sensor, run.filter.belief()
    rows = sensor.measured.landmarks
    doubted = [row for row in rows.tolist() if sensor.table.member[row] < 0][:3]
    assert len(doubted) == 3
    told = sum(group.z.size for group in sensor._observations(belief) if Part.STATE in group.updates)
    sensor.table.attempts[doubted] += 20
    groups = sensor._observations(belief)
    assert all(Part.STATE in group.updates or group.updates == {Part.LANDMARK} for group in groups)
    assert sum(group.z.size for group in groups if Part.STATE in group.updates) == told - 2 * len(doubted)


def test_where_few_are_trusted_all_of_them_tell():
    run = run_images(sequence(12), SMALL, known_points())
    table = run.sensor.table
    rows = np.arange(8)
    assert run.sensor.search.trusted(rows).all()
    table.member[rows], table.attempts[rows], table.found[rows] = -1, 10, 2
    assert run.sensor.search.trusted(rows).all()
    table.found[rows[:6]] = 10
    np.testing.assert_array_equal(run.sensor.search.trusted(rows), rows < 6)
