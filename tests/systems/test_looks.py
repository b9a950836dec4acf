"""A feature's later look: of a wall that leans away, the first one is not known again from the side."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.lie import SE3
from rbpf.sensors.feature_log import FeatureFrame
from rbpf.sensors.features import CornerDetector
from rbpf.sensors.patches.search import cut
from rbpf.systems.mono.active_search import Searched
from rbpf.systems.mono.appearance import SOURCE_HALF_PX
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.image_sensor import ImageSensor
from rbpf.systems.mono.likeness import nearest_looks
from rbpf.systems.mono.system import build_features
from rbpf.systems.mono.viewing import turned
from tests.systems.plane_sequences import CAMERA, on_plane, texture, view

SEARCH = MonoConfig().search


def around(degrees: float) -> np.ndarray:
    """A camera that looks at the middle of the wall from one side."""
    middle, turn = on_plane(np.array([500.0, 500.0])), np.deg2rad(degrees)
    axis = SE3.exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0]))
    shift = np.concatenate([[0.0, 0.0, 0.0], middle])
    return SE3.compose(SE3.compose(SE3.exp(shift), axis), SE3.exp(-shift))


@pytest.fixture
def wall():
    """A sensor with features on the wall, cut from straight ahead, and their places (K, 3)."""
    image = view(texture(), around(0.0))
    px = CornerDetector().detect(image, 40, None, 16.0, SOURCE_HALF_PX + 30.0).px
    rays = np.concatenate([CAMERA.unproject(px), np.ones((len(px), 1))], axis=1)
    corner, side, down = on_plane(np.array([[500.0, 500.0], [501.0, 500.0], [500.0, 501.0]]))
    normal = np.cross(side - corner, down - corner)
    points = rays * (normal @ corner / (rays @ normal))[:, None]
    sensor = ImageSensor(build_features(CAMERA, MonoConfig(), None), SEARCH)
    rows = sensor.table.add(np.array([cut(image, p, SOURCE_HALF_PX) for p in px]), px, around(0.0))
    sensor.table.place[rows] = np.concatenate([points, np.ones((len(px), 1))], axis=1)
    return sensor, points


def look_from(sensor, points, pose):
    """The features as they are seen from a pose become their later look."""
    image = view(texture(), pose)
    px = CAMERA.project(SE3.inverse_transform(pose, points))
    for row, place in enumerate(px):
        window = cut(image, place, SOURCE_HALF_PX)
        if window is not None:
            sensor.table.last_source[row], sensor.table.last_pose[row] = window, pose


def searched_from(sensor, points, pose):
    """What is found of the features, first as they looked at first, then as they looked later too."""
    image, search = view(texture(), pose), sensor.search
    px = CAMERA.project(SE3.inverse_transform(pose, points))
    rows, cov = np.arange(len(points)), np.tile(4.0 * np.eye(2), (len(points), 1, 1))
    templates = search._templates(rows, sensor.table.source, sensor.table.first_pose, pose)
    first = Searched(rows, px, cov, *search._looked_for(image, templates, px, cov))
    return first, search._by_last_look(image, templates.copy(), first, pose), px


def test_a_later_look_is_found_where_the_first_is_not(wall):
    sensor, points = wall
    there = around(35.0)
    first, both, px = searched_from(sensor, points, there)
    assert (both.found == first.found).all()  # no later look: nothing else to try
    look_from(sensor, points, around(20.0))
    first, both, px = searched_from(sensor, points, there)
    assert both.found[first.found].all()
    assert (both.px[first.found] == first.px[first.found]).all()
    assert both.found.sum() >= first.found.sum() + 10
    right = np.linalg.norm(both.px[both.found] - px[both.found], axis=1)
    assert np.median(right) < 1.0


def test_the_nearest_look_is_chosen(wall):
    sensor, points = wall
    look_from(sensor, points, around(30.0))
    rows, place = np.arange(len(points)), sensor.table.place
    for degrees, later in ((-10.0, False), (10.0, False), (20.0, True), (45.0, True)):
        sources, poses = nearest_looks(sensor.table, rows, place, around(degrees))
        table = sensor.table
        assert (sources == (table.last_source if later else table.source)).all()
        assert (poses == (table.last_pose if later else table.first_pose)).all()


def test_turns_are_those_around_the_place():
    place = np.append(on_plane(np.array([500.0, 500.0])), 1.0)[None]
    for degrees in (0.0, 12.0, 40.0):
        cosine, ratio = turned(place, around(degrees), around(0.0))
        assert np.rad2deg(np.arccos(np.minimum(cosine, 1.0))) == pytest.approx(degrees, abs=1e-5)
        assert ratio == pytest.approx(1.0)
    nearer = SE3.retract(around(0.0), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    assert turned(place, nearer, around(0.0))[1] == pytest.approx([2.0 / 3.0])


class Seen:
    """All of a belief that keeping looks reads."""

    def __init__(self, pose: np.ndarray) -> None:
        self.state, self.mode = pose[None], 0


def test_looks_are_kept_when_they_have_changed(wall):
    sensor, points = wall
    kept = []
    for degrees in (5.0, 14.0, 20.0, 28.0):
        pose, before = around(degrees), sensor.table.last_pose.copy()
        px = CAMERA.project(SE3.inverse_transform(pose, points))
        sensor.measured = FeatureFrame(0, np.arange(len(points)), px, np.tile(np.eye(2), (len(points), 1, 1)))
        sensor._keep_looks(view(texture(), pose), Seen(pose))
        now, then = (SE3.translation(p) - points for p in (pose, before))
        lengths = np.linalg.norm(now, axis=1), np.linalg.norm(then, axis=1)
        turn = np.rad2deg(np.arccos((now * then).sum(axis=1) / lengths[0] / lengths[1]))
        scale = np.maximum(lengths[0] / lengths[1], lengths[1] / lengths[0])
        whole = ((px >= SOURCE_HALF_PX) & (px <= np.array([319.0, 239.0]) - SOURCE_HALF_PX)).all(axis=1)
        changed = (sensor.table.last_pose != before).any(axis=1)
        assert (
            changed
            == (whole & ((turn >= SEARCH.appearance_turn_deg) | (scale >= SEARCH.appearance_scale_change)))
        ).all()
        kept.append(int(changed.sum()))
    assert kept[0] == 0
    assert min(kept[1], kept[3]) > 10
    assert (sensor.table.first_pose == around(0.0)).all()


def test_looks_are_in_the_checkpoint(wall):
    sensor, points = wall
    look_from(sensor, points, around(30.0))
    other = ImageSensor(build_features(CAMERA, MonoConfig(), None), replace(SEARCH))
    other.restore(sensor.arrays())
    assert (other.table.last_source == sensor.table.last_source).all()
    assert (other.table.last_pose == sensor.table.last_pose).all()
