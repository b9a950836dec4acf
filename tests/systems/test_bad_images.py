"""Images, points and stamps that were made by hand and are wrong: readers refuse them, a user's own source may not."""

from dataclasses import replace

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import run_images
from rbpf.validation.mono_posterior import posterior_paths
from tests.systems.plane_sequences import known_points, sequence

CONFIG = MonoConfig(particles=5)
WRONG = {
    "smaller": lambda image: image[:100, :100],
    "larger": lambda image: np.pad(image, 50),
    "colour": lambda image: np.repeat(image[..., None], 3, axis=-1),
    "empty": lambda image: image[:0],
    "no number": lambda image: image * np.nan,
}


@pytest.mark.parametrize("name", sorted(WRONG))
def test_an_image_of_another_kind_is_not_used_and_said(name):
    run = run_images(sequence(8, lambda t, image: WRONG[name](image) if t == 4 else image), CONFIG)
    assert run.stamps_ns.size == 8 and run.failure is None and not run.lost[-1]
    assert len(run.problems) == 1 and "frame 4: the image is not used: expected 320x240" in run.problems[0]
    assert run.found[4] == 0 and run.found[5] > 10


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("positions", np.nan, "positions of 8 known points"),
        ("px", np.inf, "px of 8 known points"),
        ("std_m", np.nan, "std_m of 8 known points"),
        ("std_m", -0.1, "is negative"),
    ],
)
def test_known_points_that_are_no_numbers(field, value, words):
    known = known_points()
    spoiled = getattr(known, field).copy()
    spoiled.reshape(-1)[3] = value
    with pytest.raises(InputError, match=words):
        replace(known, **{field: spoiled})


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (np.array([0.0, np.nan, 1.0]), "whole numbers"),
        (np.array([0, 5, 4]), "image 2 is before"),
        (np.zeros((3, 1), dtype=np.int64), "whole numbers"),
    ],
)
def test_stamps_that_are_none_or_run_backwards(stamps, words):
    with pytest.raises(InputError, match=words):
        replace(sequence(3), stamps_ns=stamps)


def test_a_lag_keeps_the_last_frames_and_changes_no_estimate():
    whole, last = (run_images(sequence(12), replace(CONFIG, lag=lag)) for lag in (None, 5))
    np.testing.assert_array_equal(last.world_from_camera, whole.world_from_camera)
    assert posterior_paths(whole).shape == (12, 5, 7)
    np.testing.assert_array_equal(posterior_paths(last), posterior_paths(whole)[-5:])
    np.testing.assert_array_equal(last.filter.history.stamps_ns, whole.stamps_ns[-5:])
