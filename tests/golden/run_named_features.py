"""Monocular SLAM on simulated named features, for `digests.py`: writes its path and its map."""

import sys
from pathlib import Path

import numpy as np

from examples.studies.point_worlds import MONO, DeskWorld, Measuring, simulate_features
from rbpf.runs.recordings import filter_features as run
from rbpf.systems.mono.config import MonoConfig

out = Path(sys.argv[1])
out.mkdir()
for known in (4, 0):
    log = simulate_features(DeskWorld(frames=120), Measuring(known=known), MONO, 3)
    done = run(log, MonoConfig(particles=30))
    belief = done.system.filter.belief()
    points = np.flatnonzero([belief.map.landmark_of(i).dim == 3 for i in belief.map.ids.tolist()])
    np.savez(
        out / f"known_{known}.npz",
        mean=done.log.poses,
        cov=done.log.covs,
        ess=done.log["ess"],
        log_evidence=done.log["log_evidence"],
        nis=done.log["nis"],
        state=done.system.filter.particles.state,
        log_weights=done.system.filter.particles.log_weights,
        points=points,
    )
