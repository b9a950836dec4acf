"""Which matches of active search count."""

import numpy as np
import pytest

from rbpf.systems.mono.active_search import WIDEST
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.video import run_images
from tests.systems.plane_sequences import known_points, sequence

FRAMES = 6
CONFIG = MonoConfig(particles=5)


def found_with_uncertain_depth(std_px: float) -> tuple[list[bool], int]:
    """Whether a feature that could be so far off, wherever the camera is, was found each time; how many others were."""
    doubted = known_points().names.size  # the first that is no known point

    def widened(t, frame, run):
        search = run.sensor.search
        told = type(search)._innovations

        def innovations(belief, rows, px):
            which, nu, jac, cov = told(search, belief, rows, px)
            along = np.where(rows[which] == doubted, std_px**2, 0.0)[:, None, None] * np.diag([1.0, 0.0])
            return which, nu, jac, cov + along

        search._innovations = innovations

    run = run_images(sequence(FRAMES), CONFIG, known_points(), widened)
    later = run.sightings.frames[2:]
    found = [bool(frame.found[frame.rows == doubted][0]) for frame in later if doubted in frame.rows]
    return found, int(later[-1].found.sum())


@pytest.mark.parametrize("fraction", [0.9, 1.1])
def test_a_feature_that_may_be_anywhere_agrees_with_no_motion(fraction):
    """What is alike within a small part of its ellipse is alike by chance."""
    widest = WIDEST * CONFIG.search.max_radius_px / CONFIG.search.ellipse_sigmas
    found, others = found_with_uncertain_depth(fraction * widest)
    assert found and all(one == (fraction < 1.0) for one in found)
    assert others > 10
