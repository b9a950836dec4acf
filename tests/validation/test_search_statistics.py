"""Figures of active search: survival against a worked example, noise of images against what was added."""

import numpy as np
import pytest

from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.search_statistics import measure_search, survival
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk

CAMERA = Pinhole(320, 240, 262.0, 262.0, 159.5, 119.5)


def test_survival_is_that_of_kaplan_and_meier():
    # Remission of leukaemia under 6-mercaptopurine, weeks (E. Freireich et al. 1963); + is out of sight.
    ended = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    watched = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    lengths = np.array(ended + watched)
    curve = survival(lengths, np.arange(lengths.size) < len(ended), 35)
    known = {
        0: 1.0,
        5: 1.0,
        6: 0.857,
        7: 0.807,
        10: 0.753,
        13: 0.690,
        16: 0.627,
        22: 0.538,
        23: 0.448,
        35: 0.448,
    }
    assert {week: curve[week] for week in known} == pytest.approx(known, abs=5e-4)


def test_nothing_watched_survives():
    assert survival(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), 3).tolist() == [1.0, 1.0, 1.0, 1.0]


@pytest.mark.slow
def test_searches_are_counted_and_the_noise_is_seen(tmp_path):
    imaging = Imaging(noise_std=4.0, lens_px=1.0, grid=1)
    simulate_images(TexturedDesk(frames=25, texel_m=0.003), imaging, CAMERA, tmp_path / "desk", 0)
    found = measure_search(tmp_path / "desk", MonoConfig(particles=5))
    assert (found.name, found.frames, found.lost) == ("desk", 25, 0)
    assert found.score.size == found.found.size > 20 * 20
    assert found.share_found + found.share_unlike + found.share_astray == pytest.approx(1.0, abs=0.02)
    assert found.share_found > 0.8
    # Every search is counted once, beside the sighting that starts a feature.
    assert found.attempts.sum() - found.attempts.size == found.score.size
    assert found.survival(50)[0] == 1.0
    assert (np.diff(found.survival(50)) <= 0.0).all()
    # The smoothest blocks have a little less of it than all.
    assert 3.3 < found.noise < 4.4
    assert found.contrast > found.noise
