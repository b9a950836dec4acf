"""Figures of active search: survival against a worked example, noise of images against what was added."""

from dataclasses import replace

import numpy as np
import pytest

from examples.studies.consistency_runs import Consistency, DeskTrial, Trial, left_for_good, run_trials
from examples.studies.mono_realism import measure_search, survival
from examples.studies.point_worlds import STEREO, DeskWorld, LabWorld, Measuring, simulate_features
from examples.studies.stereo_revisit import log_there_and_back
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images
from rbpf.validation.simulation.lab import LabDrive


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


def test_an_overconfident_filter_is_found_from_the_first_step():
    rng = np.random.default_rng(1)
    found = Consistency([honest(rng, 1.5) for _ in range(60)])
    assert found.overconfident_from == 0
    assert found.pose_nees.value == pytest.approx(2.25, rel=0.1)


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


def test_a_desk_trial_counts_points_and_ancestors():
    trial = DeskTrial(DeskWorld(frames=40), MonoConfig(particles=20))
    found = run_trials(trial, [0]).trials[0]
    assert found.ancestors.shape == (40,)
    assert found.ancestors[-1] == 20
    assert (np.diff(found.ancestors) >= 0).all()
    assert 0.1 < np.nanmean(found.nees) / 6 < 10
    assert found.distances.max() < 0.05


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


def test_pixels_come_again_in_reverse():
    world = LabWorld(LabDrive(frames=4, every=4), points=2000)
    log = simulate_features(world, Measuring(known=0), STEREO, seed=0)
    both = log_there_and_back(log)
    assert [frame.stamp_ns for frame in both.frames] == list(range(7))
    for t, row in enumerate([0, 1, 2, 3, 2, 1, 0]):
        np.testing.assert_array_equal(both.frames[t].landmarks, log.frames[row].landmarks)
        np.testing.assert_array_equal(both.frames[t].z, log.frames[row].z)
        np.testing.assert_array_equal(both.truth.world_from_camera[t], log.truth.world_from_camera[row])
    np.testing.assert_array_equal(both.truth.stamps_ns, np.arange(7))
    assert log_there_and_back(replace(log, truth=None)).truth is None
