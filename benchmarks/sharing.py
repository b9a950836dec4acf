"""Storage of 11,085 landmarks in 400 particles after 1,000 resamplings."""

import numpy as np

from benchmarks.rows import Row, Settings
from rbpf.genealogy import Lineage
from rbpf.maps.shared import SharedStore
from rbpf.resampling import Systematic

N, M, FIELDS, IN_VIEW = 400, 11_085, 9, 100
RESAMPLINGS = 1_000
STEPS_PER_VIEW = 10
DISPERSION = 0.08
AIM_SHARE, AIM_LINEAGES = 0.10, 20


def run(settings: Settings) -> list[Row]:
    """Systematic resampling at every step by log-normal weights; what is in view is rewritten at every step.

    The dispersion is chosen so that more than 20 particles of the first generation keep descendants. The size does
    not shrink in a quick run: it is the figure.
    """
    rng = np.random.default_rng(0)
    lineage = Lineage(N)
    lineage.retain(0)
    store = SharedStore(N, lineage)
    columns = np.array([store.add(np.zeros((FIELDS, N))) for _ in range(M)])
    peak = 0.0
    for t in range(RESAMPLINGS):
        weights = np.exp(DISPERSION * rng.normal(size=N))
        lineage.advance(Systematic().ancestors(weights / weights.sum(), rng))
        store.compact()
        first = t // STEPS_PER_VIEW * IN_VIEW
        rewrite(store, columns[(first + np.arange(IN_VIEW)) % M])
        if t >= RESAMPLINGS // 2:
            peak = max(peak, store.stored_bytes / store.dense_bytes)
    share = store.stored_bytes / store.dense_bytes
    survivors = lineage.distinct(0)
    return [
        Row(
            f"map storage {N}x{M}",
            store.stored_bytes / 1e6,
            "MB",
            "a copy per particle",
            store.dense_bytes / 1e6,
            share,
            higher=False,
            aim=f"<= {AIM_SHARE:.0%} of dense, >= {AIM_LINEAGES} lineages",
            met=share <= AIM_SHARE and survivors >= AIM_LINEAGES,
            notes=(
                f"{survivors} lineages of the first generation survive {RESAMPLINGS} resamplings; weights log-normal "
                f"with deviation {DISPERSION:g}; every landmark rewritten for {STEPS_PER_VIEW} steps while in view, "
                f"{IN_VIEW} at a time; at most {peak:.3f} of dense in the second half; {lineage.nodes} nodes"
            ),
            tolerance=0.1,
        )
    ]


def rewrite(store: SharedStore, columns: np.ndarray) -> None:
    """What the kernel of an update does to the store, with the step as the record."""
    access, targets = store.rewrite(columns)
    access.pool[targets] = float(store.lineage.generation)
