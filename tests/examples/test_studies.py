"""Figures of active search: survival against a worked example, noise of images against what was added."""

import numpy as np
import pytest

from examples.studies.consistency_runs import Consistency, Trial, left_for_good
from examples.studies.mono_realism import measure_search, survival
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images


def honest(rng: np.random.Generator, scale: float = 1.0, steps: int = 60) -> Trial:
    """A trial of a filter whose standard deviations are `scale` times too small."""
    nees = scale**2 * rng.chisquare(3, size=steps)
    nis, dof = rng.chisquare(8, size=steps), np.full(steps, 8.0)
    landmarks = scale**2 * rng.chisquare(2, size=30)
    return Trial(3, np.sqrt(nees), nees, nis, dof, landmarks, 2, np.full(steps, 5), None, 0.0)


def test_an_honest_filter_has_the_figures_of_one():
    rng = np.random.default_rng(0)
    found = Consistency([honest(rng) for _ in range(60)])
    assert found.overconfident_from is None
    assert found.pose_nees.value == pytest.approx(1.0, abs=3 * found.pose_nees.error)
    assert found.landmark_nees.value == pytest.approx(1.0, abs=3 * found.landmark_nees.error)
    assert found.nis.value == pytest.approx(1.0, abs=3 * found.nis.error)
    for probability in (0.5, 0.9, 0.95):
        coverage = found.coverage(probability)
        assert coverage.value == pytest.approx(probability, abs=4 * coverage.error)
    inside = (found.mean_nees > found.band().low) & (found.mean_nees < found.band().high)
    assert inside.mean() > 0.85
    assert found.coalescence == np.inf
    assert found.entries()["overconfident_from"] == "never"


def by_definition(mean: np.ndarray, high: float) -> int | None:
    """First step above the band such that, for each later step, at least half of those up to it are above."""
    above = mean > high
    for t in range(mean.size):
        if above[t] and all(above[t : s + 1].mean() >= 0.5 for s in range(t, mean.size)):
            return t if t <= mean.size - 10 else None
    return None


def test_leaving_for_good_is_what_the_definition_says():
    rng = np.random.default_rng(2)
    for _ in range(200):
        mean = rng.normal(size=50).cumsum() * 0.3 + rng.normal(size=50)
        assert left_for_good(mean, 0.5) == by_definition(mean, 0.5)


CAMERA = Pinhole(320, 240, 262.0, 262.0, 159.5, 119.5)


def test_survival_is_that_of_kaplan_and_meier():
    # Remission of leukaemia under 6-mercaptopurine, weeks (E. Freireich et al. 1963); + is out of sight.
    ended = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    watched = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    lengths = np.array(ended + watched)
    curve = survival(lengths, np.arange(lengths.size) < len(ended), 35)
    known = {0: 1.0, 5: 1.0, 6: 0.857, 7: 0.807, 10: 0.753, 13: 0.690, 16: 0.627, 22: 0.538, 23: 0.448, 35: 0.448}
    assert {week: curve[week] for week in known} == pytest.approx(known, abs=5e-4)


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
