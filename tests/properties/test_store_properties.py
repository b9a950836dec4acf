"""The copy-on-write store against deep copies for every particle, under any sequence of operations."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rbpf.core.genealogy import Lineage
from rbpf.errors import InputError
from rbpf.maps.store import SharedStore


@dataclass
class Copies:
    """One array (fields, N) per column, gathered at every resampling."""

    columns: dict[int, np.ndarray] = field(default_factory=dict)

    def resample(self, ancestors: np.ndarray) -> None:
        self.columns = {column: records[:, ancestors] for column, records in self.columns.items()}


def kernel_like(store: SharedStore, columns: np.ndarray, increments: np.ndarray) -> None:
    """What the compiled drivers do, row after row: read an inherited record, write one's own."""
    access, targets = store.rewrite(columns)
    for k in range(columns.size):
        rows = access.maps[access.which[k]]
        access.pool[targets[k]] = access.pool[access.slabs[k]][:, rows] + increments[k]


class Trial:
    """A store and its copies under random operations; after each one they must read the same."""

    def __init__(self, n: int, seed: int) -> None:
        self.n, self.rng = n, np.random.default_rng(seed)
        self.lineage = Lineage(n)
        self.store = SharedStore(n, self.lineage)
        self.copies = Copies()
        self.given: list[int] = []
        self.add()

    def some(self) -> tuple[np.ndarray, int]:
        """Columns of one record size, some of them named several times, and the size."""
        fields = len(self.copies.columns[int(self.rng.choice(list(self.copies.columns)))])
        alike = [column for column, records in self.copies.columns.items() if len(records) == fields]
        return self.rng.choice(alike, size=self.rng.integers(1, 7)), fields

    def add(self) -> None:
        for _ in range(self.rng.integers(1, 12)):
            records = self.rng.normal(size=(self.rng.integers(1, 4), self.n))
            column = int(self.store.add(records[None])[0])
            assert column not in self.given
            self.given.append(column)
            self.copies.columns[column] = records.copy()
            records[:] = np.nan

    def remove(self) -> None:
        columns, _ = self.some()
        self.store.remove(columns)
        for column in set(columns.tolist()):
            del self.copies.columns[column]

    def replace(self) -> None:
        column = int(self.rng.choice(list(self.copies.columns)))
        self.copies.columns[column] = self.rng.normal(size=(self.rng.integers(1, 4), self.n))
        self.store.replace(np.array([column]), self.copies.columns[column][None].copy())

    def rewrite(self) -> None:
        columns, fields = self.some()
        increments = self.rng.normal(size=(columns.size, fields, self.n))
        kernel_like(self.store, columns, increments)
        for column, increment in zip(columns.tolist(), increments, strict=True):
            self.copies.columns[column] = self.copies.columns[column] + increment

    def access(self) -> None:
        columns, _ = self.some()
        access = self.store.access(columns)
        for k, column in enumerate(columns.tolist()):
            read = access.pool[access.slabs[k]][:, access.maps[access.which[k]]]
            np.testing.assert_array_equal(read, self.copies.columns[column])

    def resample(self) -> None:
        concentration = self.rng.choice([0.05, 1.0, 20.0])
        for _ in range(self.rng.choice([1, 1, 1, 2, 5, 12])):
            weights = self.rng.dirichlet(np.full(self.n, concentration))
            ancestors = np.sort(self.rng.choice(self.n, size=self.n, p=weights))
            self.lineage.advance(ancestors)
            self.store.compact()
            self.copies.resample(ancestors)

    def save_and_restore(self) -> None:
        arrays = self.lineage.arrays() | self.store.arrays()
        self.lineage = Lineage(self.n)
        self.lineage.restore(arrays)
        bytes_before = self.store.stored_bytes
        self.store = SharedStore(self.n, self.lineage)
        self.store.restore(arrays)
        assert self.store.stored_bytes == bytes_before
        again = self.store.arrays()
        for name in again:
            np.testing.assert_array_equal(again[name], arrays[name])

    def check(self) -> None:
        np.testing.assert_array_equal(self.store.ids, sorted(self.copies.columns))
        names = np.arange(-1, max(self.given) + 2)
        np.testing.assert_array_equal(self.store.columns.held(names), np.isin(names, list(self.copies.columns)))
        for column, records in self.copies.columns.items():
            read = self.store.read(column)
            np.testing.assert_array_equal(read, records)
            read[:] = np.nan  # may be written to
        if self.copies.columns:
            columns, _ = self.some()
            particles = self.rng.integers(0, self.n, self.rng.integers(1, 5))
            together = [self.copies.columns[column][:, particles] for column in columns.tolist()]
            np.testing.assert_array_equal(self.store.read_all(columns, particles), together)
        assert self.store.dense_bytes == 8 * sum(records.size for records in self.copies.columns.values())
        # A compacted column holds at most half of the rows, and for each an index beside the fields.
        assert self.store.stored_bytes <= 2 * self.store.dense_bytes

    def run(self, steps: int) -> set[str]:
        """Random operations; returns which ones met records that are shared, compacted or both."""
        met = set()
        names = ["add", "remove", "replace", "rewrite", "rewrite", "access", "resample", "resample", "save_and_restore"]
        for _ in range(steps):
            name = str(self.rng.choice(names if self.copies.columns else ["add"]))
            arrays = self.store.arrays()
            moved = any((self.lineage.rows(g) != np.arange(self.n)).any() for g in arrays["store/generation"])
            cold = any(key.endswith("/kept") for key in arrays)
            getattr(self, name)()
            self.check()
            met |= {f"{name} {what}" for what, was in (("moved", moved), ("cold", cold)) if was}
        return met


@pytest.mark.slow
@given(n=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_reads_like_copies(n, seed):
    Trial(n, seed).run(steps=40)


def test_random_operations_meet_every_state():
    met = set().union(*(Trial(6, seed).run(40) for seed in range(5)))
    for name in ("add", "remove", "replace", "rewrite", "access", "resample", "save_and_restore"):
        assert {f"{name} moved", f"{name} cold"} <= met


def test_rewriting_one_landmark_leaves_the_others_shared():
    rng = np.random.default_rng(3)
    n = 64
    lineage = Lineage(n)
    store = SharedStore(n, lineage)
    columns = store.add(rng.normal(size=(20, 5, n)))
    for _ in range(200):
        lineage.advance(np.sort(rng.integers(0, n, n)))
        store.compact()
        kernel_like(store, columns[:1], np.zeros((1, 5, n)))
    dense = 5 * n * 8
    assert dense <= store.stored_bytes <= dense + 19 * 0.2 * dense


@pytest.mark.parametrize("shape", [(5, 3), (1, 5, 2), (1, 0, 3), (1, 2, 5, 3)])
def test_records_of_wrong_shape_change_nothing(shape):
    store = SharedStore(3, Lineage(3))
    column = store.add(np.ones((1, 2, 3)))
    for change in (lambda: store.add(np.zeros(shape)), lambda: store.replace(column, np.zeros(shape))):
        with pytest.raises(InputError, match=r"landmark records must be \(K, fields, 3\)"):
            change()
        np.testing.assert_array_equal(store.read_all(column), np.ones((1, 2, 3)))
        assert store.ids.tolist() == column.tolist()
