"""Covariances by the reduced system against GTSAM's elimination of everything, and what is not determined."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.validation.gtsam import camera_adjust as adjuster
from rbpf.validation.gtsam.camera_data import CameraEstimate, known_by_name, sightings_of
from rbpf.validation.gtsam.camera_graph import CameraProblem
from rbpf.validation.gtsam.schur import marginals_by_schur
from rbpf.validation.gtsam.solvers import marginals
from tests.validation.camera_scenes import BENT, STEREO, scene


def adjusted(camera, known: str):
    """The optimum of a small scene, with known points as they are, exact ones, or none."""
    log = scene(camera)
    if known == "exact":
        log = replace(log, known=replace(log.known, cov=np.zeros_like(log.known.cov)))
    if known == "none":
        log = replace(log, known=None)
    table, names = sightings_of(log), {}
    if log.known is not None:
        names = known_by_name(log.known, table.names)
    stamps = np.array([frame.stamp_ns for frame in log.frames])
    problem = CameraProblem(log.name, stamps, table, names)
    start = adjuster.begin(problem, CameraEstimate(log.truth.world_from_camera, {}))
    return adjuster.adjust(problem, start)


@pytest.mark.parametrize(
    ("camera", "known"),
    [(BENT, "uncertain"), (BENT, "exact"), (STEREO, "uncertain"), (STEREO, "exact"), (STEREO, "none")],
)
def test_they_are_those_of_a_full_elimination(camera, known):
    found = adjusted(camera, known)
    problem = found.problem
    keys = problem.pose_keys, problem.point_keys
    assert bool(problem.held_keys) == (known != "uncertain")
    poses, points = marginals_by_schur(found.graph, found.values, *keys, problem.held_keys, problem.name)
    whole = marginals(found.graph, found.values, [*keys[0], *keys[1]])
    for one, other in zip([*poses, *points], whole, strict=True):
        scale = max(np.abs(other).max(), 1e-12)
        np.testing.assert_allclose(one, other, atol=1e-6 * scale)


def test_a_landmark_that_nothing_determines_is_refused():
    """A single camera's only sighting of a point leaves its distance open."""
    found = adjusted(STEREO, "none")
    problem, graph = found.problem, gtsam.NonlinearFactorGraph()
    last = problem.point_keys[-1]
    for index in range(found.graph.size()):
        keys = list(found.graph.at(index).keys())
        if last not in keys:
            graph.push_back(found.graph.at(index))
    values = gtsam.Values(found.values)
    weak = gtsam.noiseModel.Diagonal.Sigmas(np.array([1.0, 1.0, np.inf]))
    graph.push_back(gtsam.PriorFactorPoint3(last, values.atPoint3(last), weak))
    with pytest.raises(InputError, match="do not determine all poses and landmarks"):
        marginals_by_schur(
            graph, values, problem.pose_keys, problem.point_keys, problem.held_keys, problem.name
        )
