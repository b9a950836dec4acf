"""Storage of 11,085 landmarks in 400 particles after 1,000 resamplings."""

import numpy as np

from benchmarks.rows import Row, Settings
from rbpf.core.genealogy import Lineage
from rbpf.core.resampling import Systematic
from rbpf.maps.store import SharedStore

N, M, FIELDS, IN_VIEW = 400, 11_085, 9, 100
RESAMPLINGS = 1_000
DISPERSION = 0.08
REAL = 8


def run(settings: Settings) -> list[Row]:
    """Systematic resampling at every step with log-normal weights; landmarks in view are rewritten at every step.

    The map exists from the start; the view moves on by one landmark per step. The weights' dispersion is chosen so that
    more than 20 particles of the first generation keep descendants. A quick run is the same, as the size is the figure.
    """
    rng = np.random.default_rng(0)
    lineage = Lineage(N)
    lineage.retain(0)
    store = SharedStore(N, lineage)
    columns = store.add(np.zeros((M, FIELDS, N)))
    written = np.zeros(M, dtype=int)
    for t in range(RESAMPLINGS):
        weights = np.exp(DISPERSION * rng.normal(size=N))
        lineage.advance(Systematic().ancestors(weights / weights.sum(), rng))
        store.compact()
        view = (t + np.arange(IN_VIEW)) % M
        rewrite(store, columns[view])
        written[view] = lineage.generation
    return [figure(store, written)]


def rewrite(store: SharedStore, columns: np.ndarray) -> None:
    """Writes to the store like an update's kernel, with the generation as the record."""
    access, targets = store.rewrite(columns)
    access.pool[targets] = float(store.lineage.generation)


def figure(store: SharedStore, written: np.ndarray) -> Row:
    """Stored records against a copy per particle, and against one record per writer with descendants."""
    fraction, survivors = store.stored_bytes / store.dense_bytes, store.lineage.distinct(0)
    alive = {int(generation): store.lineage.distinct(int(generation)) for generation in np.unique(written)}
    least = sum(alive[generation] for generation in written.tolist()) * FIELDS * REAL / store.dense_bytes
    return Row(
        f"map storage {N}x{M}",
        store.stored_bytes / 1e6,
        "MB",
        "a copy per particle",
        store.dense_bytes / 1e6,
        fraction,
        higher=False,
        notes=(
            f"{survivors} lineages of the first generation survive {RESAMPLINGS} resamplings; weights log-normal "
            f"with deviation {DISPERSION:g}; {IN_VIEW} landmarks rewritten per step, one of them new; one record per "
            f"surviving writer would be {least:.3f} of dense; {store.lineage.nodes} nodes"
        ),
        tolerance=0.1,
    )
