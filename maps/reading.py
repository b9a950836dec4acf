"""Estimates read out of the store, and where a sensor should see them; compiled where nothing stands in the way."""

import numpy as np

from rbpf.kernels.gather import gather
from rbpf.kernels.project import project
from rbpf.maps.layout import Layout
from rbpf.maps.shared import ALL, SharedStore
from rbpf.models import FusedKernel, Records
from rbpf.proposals import Prior


def read_records(
    store: SharedStore, layout: Layout, ids: np.ndarray, particles: np.ndarray | slice = ALL
) -> Records:
    """Estimates (N, K, …) of landmarks (K,) of one parametrisation, in all or some particles; cold ones stay cold."""
    landmark = layout.landmark
    if particles is not ALL or landmark.components > 1 or not store.is_warm(ids):
        return layout.unpack(np.array([store.read(int(i), particles) for i in ids]))
    n, k, dim = store.n, ids.size, landmark.dim
    access = store.access(ids)
    mean, cov, const = np.empty((n, k, dim)), np.empty((n, k, dim, dim)), np.empty((n, k, landmark.constants))
    gather(access.pool, access.slabs, access.which, access.maps, mean, cov, const)
    return Records(mean, cov, const if landmark.constants else None)


def project_compiled(
    store: SharedStore,
    layout: Layout,
    kernel: FusedKernel,
    ids: np.ndarray,
    anchor: np.ndarray,
    weights: np.ndarray,
    prior: Prior,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (K, p) relative to the anchors (K, p), and covariance (K, p, p), of what is measured of landmarks (K,).

    They are of one parametrisation with one component, and none is cold.
    """
    count, p = anchor.shape
    access = store.access(ids)
    mean, cov = np.empty((count, p)), np.empty((count, p, p))
    project(
        kernel.function,
        kernel.params,
        np.ascontiguousarray(prior.predicted()),
        access.pool,
        access.slabs,
        access.which,
        access.maps,
        np.ascontiguousarray(anchor),
        weights,
        np.ascontiguousarray(prior.spread(prior.mean)),
        np.array([prior.space.dim, layout.landmark.dim, layout.landmark.constants]),
        mean,
        cov,
    )
    return mean, cov
