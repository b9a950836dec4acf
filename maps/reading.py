"""Estimates read out of the store, and where a sensor should see them; compiled where nothing stands in the way."""

import numpy as np

from rbpf.core.models import FusedKernel, Jacobians, ObservationModel, Records
from rbpf.core.numeric import linearise
from rbpf.core.proposals import Prior
from rbpf.kernels.gather import gather
from rbpf.kernels.project import project
from rbpf.kernels.single import linearise_one
from rbpf.lie import LieGroup
from rbpf.maps.layout import Layout
from rbpf.maps.shared import ALL, SharedStore


def read_records(
    store: SharedStore, layout: Layout, ids: np.ndarray, particles: np.ndarray | slice = ALL
) -> Records:
    """Estimates (N, K, …) of landmarks (K,) of one parametrisation, in all or some particles; cold ones stay cold."""
    landmark = layout.landmark
    if landmark.components > 1 or not store.is_warm(ids):
        return layout.unpack(store.read_all(ids, particles))
    access = store.access(ids)
    maps = access.maps if particles is ALL else np.ascontiguousarray(access.maps[:, particles])
    n, k, dim = maps.shape[1], ids.size, landmark.dim
    mean, cov, const = np.empty((n, k, dim)), np.empty((n, k, dim, dim)), np.empty((n, k, landmark.constants))
    gather(access.pool, access.slabs, access.which, maps, mean, cov, const)
    return Records(mean, cov, const if landmark.constants else None)


def linearise_one_particle(
    model: ObservationModel,
    kernel: FusedKernel | None,
    space: LieGroup,
    records: Records,
    z: np.ndarray,
    state: np.ndarray,
) -> tuple[np.ndarray, Jacobians]:
    """Innovations (K, p) and Jacobians of one particle's landmarks, records (1, K, …), at its state (E,).

    What `rbpf.core.numeric.linearise` gives, by the model's kernel where there is one.
    """
    mean = records.mean[0]
    const = None if records.const is None else records.const[0]
    if kernel is None or records.log_weights is not None:
        return linearise(model, space, z, state[None], mean, const)
    count, p = z.shape
    nu, jac_state, jac_map = (
        np.empty((count, p)),
        np.empty((count, p, space.dim)),
        np.empty((*z.shape, mean.shape[1])),
    )
    const = np.empty((count, 0)) if const is None else const
    arrays = (np.ascontiguousarray(array, dtype=float) for array in (state, mean, const, z))
    linearise_one(kernel.function.address, kernel.params, *arrays, nu, jac_state, jac_map)
    return nu, Jacobians(jac_state, jac_map)


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
        kernel.function.address,
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
