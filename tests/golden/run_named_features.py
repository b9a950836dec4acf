"""Monocular SLAM on simulated named features, for `digests.py`: writes its path and its map."""

import sys
from pathlib import Path

import numpy as np

from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.run import run
from rbpf.validation.simulation.features import MONO, Measuring, simulate_features
from rbpf.validation.simulation.point_worlds import DeskWorld

out = Path(sys.argv[1])
out.mkdir()
for known in (4, 0):
    log = simulate_features(DeskWorld(frames=120), Measuring(known=known), MONO, 3)
    done = run(log, MonoConfig(particles=30))
    belief = done.filter.belief()
    points = np.flatnonzero([belief.map.landmark_of(i).dim == 3 for i in belief.map.ids.tolist()])
    np.savez(
        out / f"known_{known}.npz",
        mean=done.world_from_camera,
        cov=done.cov,
        ess=done.ess,
        log_evidence=done.log_evidence,
        nis=done.nis,
        state=done.filter.particles.state,
        log_weights=done.filter.particles.log_weights,
        points=points,
    )
