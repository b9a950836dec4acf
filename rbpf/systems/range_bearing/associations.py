"""Which landmark each sighting was given: what the batch optimiser has to be told."""

import numpy as np

from rbpf.core.filter import Filter, StepReport
from rbpf.core.models import NEW, NULL
from rbpf.sensors.readers.log import RobotLog


def named_associations(log: RobotLog) -> list[np.ndarray]:
    """The log's names, per step; −1 where a new landmark is sighted a second time in its first frame."""
    seen: set[int] = set()
    steps = []
    for frame in log.frames:
        names = frame.landmarks.tolist()
        used = [name if name in seen or name not in names[:k] else NULL for k, name in enumerate(names)]
        seen.update(names)
        steps.append(np.array(used, dtype=np.int64))
    return steps


class Associations:
    """Ids of every sighting in every particle, until it is known which lineage survives.

    Args:
        filter_: whose steps are recorded.
    """

    def __init__(self, filter_: Filter) -> None:
        self._filter = filter_
        self._steps: list[tuple[int, np.ndarray]] = []

    def record(self, report: StepReport, sightings: int) -> None:
        """Keeps a step's ids (n, K), n = 1 where all particles agree; what was new gets the ids of the new_landmarks."""
        ids = np.full((1, sightings), NULL)
        if report.groups and report.groups[0].ids is not None and report.groups[0].ids.ndim == 2:
            ids = report.groups[0].ids.copy()
            columns = np.flatnonzero((ids == NEW).any(axis=0))
            for column, landmark in zip(columns, report.new_landmarks, strict=True):
                ids[ids[:, column] == NEW, column] = landmark
            if (ids == ids[:1]).all():
                ids = ids[:1]
        lineage = self._filter.lineage
        if ids.shape[0] > 1:
            lineage.retain(lineage.generation)
        self._steps.append((lineage.generation, ids))

    def of(self, particle: int) -> list[np.ndarray]:
        """Ids along the ancestors of a particle, one array per step."""
        lineage = self._filter.lineage
        return [ids[lineage.rows(g)[particle] if ids.shape[0] > 1 else 0] for g, ids in self._steps]

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        shapes = [(g, *ids.shape) for g, ids in self._steps]
        flat = [ids.ravel() for _, ids in self._steps]
        return {
            "associations/shapes": np.array(shapes, dtype=np.int64).reshape(-1, 3),
            "associations/ids": np.concatenate([np.zeros(0, dtype=np.int64), *flat]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        first = 0
        for generation, n, k in arrays["associations/shapes"].tolist():
            ids = arrays["associations/ids"][first : first + n * k].reshape(n, k)
            first += n * k
            if n > 1:
                self._filter.lineage.take_up(generation)
            self._steps.append((generation, ids.copy()))
