"""What the store is made of: records as columns and back, and tables of columns that come and go beside a dictionary."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.models import Landmark, Records
from rbpf.errors import InputError
from rbpf.maps.store import Columns, Layout


class Free(Landmark):
    """A parametrisation of any size."""

    def __init__(self, dim: int, constants: int = 0, components: int = 1) -> None:
        self.dim, self.constants, self.components = dim, constants, components

    def homogeneous(self, mean, const=None):
        return np.concatenate([mean[..., :2], np.ones((*mean.shape[:-1], 1))], axis=-1)


def random_records(landmark: Landmark, n: int, k: int, rng: np.random.Generator) -> Records:
    inner = (n, k) if landmark.components == 1 else (n, k, landmark.components)
    factor = rng.normal(size=(*inner, landmark.dim, landmark.dim))
    cov = factor @ np.swapaxes(factor, -1, -2)
    return Records(
        rng.normal(size=(*inner, landmark.dim)),
        0.5 * (cov + np.swapaxes(cov, -1, -2)),
        rng.normal(size=(n, k, landmark.constants)) if landmark.constants else None,
        rng.normal(size=inner) if landmark.components > 1 else None,
    )


@given(
    dim=st.integers(1, 6),
    constants=st.integers(0, 7),
    components=st.integers(1, 5),
    n=st.integers(1, 4),
    k=st.integers(0, 3),
    evidence=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(dim, constants, components, n, k, evidence, seed):
    rng = np.random.default_rng(seed)
    layout = Layout(Free(dim, constants, components), evidence)
    records, log_odds = random_records(layout.landmark, n, k, rng), rng.normal(size=(n, k))
    columns = layout.pack(records, log_odds if evidence else None)
    assert columns.shape == (k, layout.fields, n)
    assert columns.flags.c_contiguous
    again = layout.unpack(columns)
    for name, expected in vars(records).items():
        found = getattr(again, name)
        assert (found is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(found, expected)
    if evidence:
        np.testing.assert_array_equal(columns[:, -1].T, log_odds)


def test_constants_may_be_shared_by_all_particles():
    records = random_records(Free(2), 3, 2, np.random.default_rng(0))
    const = np.arange(8.0).reshape(1, 2, 4)
    columns = Layout(Free(2, 4)).pack(Records(records.mean, records.cov, const))
    unpacked = Layout(Free(2, 4)).unpack(columns)
    np.testing.assert_array_equal(np.asarray(unpacked.const), np.repeat(const, 3, axis=0))


GOOD = random_records(Free(2), 3, 2, np.random.default_rng(0))
WEIGHTS = np.zeros((3, 2, 2))


@pytest.mark.parametrize(
    ("landmark", "records", "match"),
    [
        (Free(3), GOOD, r"Free has 1 component\(s\) of dimension 3: expected means \(3, 2, 3\)"),
        (Free(2, components=2), GOOD, r"expected means \(3, 2, 2, 2\)"),
        (Free(2), Records(GOOD.mean, GOOD.cov[:, :1]), r"covariances \(3, 1, 2, 2\)"),
        (Free(2, constants=4), GOOD, "Free has 4 constants per landmark: give them in Records.const"),
        (Free(2), Records(GOOD.mean, GOOD.cov, np.zeros((3, 2, 1))), "Free has 0 constants per landmark"),
        (Free(2), Records(GOOD.mean, GOOD.cov, None, WEIGHTS), "needs log_weights exactly if it has several"),
        (Free(2), Records(GOOD.mean * np.nan, GOOD.cov), "a new Free has a mean or covariance that is not finite"),
        (Free(2), Records(GOOD.mean, GOOD.cov * np.inf), "a new Free has a mean or covariance that is not finite"),
    ],
)
def test_records_that_do_not_fit(landmark, records, match):
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match=match):
        Layout(landmark).pack(records)


def filled(columns: Columns, ids: list[int | None]) -> list[int]:
    """New columns; everything noted of one follows from its id."""
    added = []
    for wanted in ids:
        column = columns.add(wanted)
        row = columns.row(column)
        columns.fields[row], columns.generation[row] = column + 1, 2 * column
        columns.slab[row], columns.kind[row] = 3 * column, column % 3
        added.append(column)
    return added


@given(
    st.lists(st.tuples(st.integers(0, 90), st.integers(0, 90), st.integers(0, 2**32 - 1), st.booleans()), max_size=8)
)
def test_as_a_dictionary(edits):
    """Ids that are counted up, and ids of the caller's in any order."""
    columns, model, next_id = Columns(), dict[int, int](), 0
    for new, gone, seed, numbered in edits:
        rng = np.random.default_rng(seed)
        free = np.setdiff1d(np.arange(1000), list(model))
        ids = rng.choice(free, new, replace=False).tolist() if numbered else [None] * new
        added = filled(columns, ids)
        assert added == (ids if numbered else list(range(next_id, next_id + new)))
        next_id = max([next_id, *(column + 1 for column in added)])
        model |= {column: column % 3 for column in added}
        removed = rng.choice(sorted(model), min(gone, len(model)), replace=False).astype(np.int64)
        columns.remove(removed)
        for column in removed.tolist():
            del model[column]
        ids = np.array(list(model), dtype=np.int64)
        np.testing.assert_array_equal(columns.ids, ids)
        assert columns.next_id == next_id
        again = Columns()
        again.restore(ids, next_id)
        np.testing.assert_array_equal(again.rows(ids), columns.rows(ids))
        rows = columns.rows(ids)
        np.testing.assert_array_equal(rows, np.arange(ids.size))
        assert [columns.row(column) for column in model] == rows.tolist()
        np.testing.assert_array_equal(columns.fields[rows], ids + 1)
        np.testing.assert_array_equal(columns.generation[rows], 2 * ids)
        np.testing.assert_array_equal(columns.slab[rows], 3 * ids)
        asked = np.arange(-2, next_id + 3)
        np.testing.assert_array_equal(columns.held(asked), [column in model for column in asked.tolist()])
        np.testing.assert_array_equal(columns.kinds(asked), [model.get(column, -1) for column in asked.tolist()])


def test_memory_follows_what_is_held():
    """A thousand columns at once; then one at a time for ever."""
    columns = Columns()
    filled(columns, [None] * 1000)
    assert columns.fields.size == 1024
    columns.remove(np.arange(990))
    assert columns.fields.size == 64
    for oldest in range(990, 6000):
        filled(columns, [None])
        columns.remove(np.array([oldest]))
    assert columns.fields.size == 64 and columns.next_id == 6010
    np.testing.assert_array_equal(columns.ids, np.arange(6000, 6010))
    np.testing.assert_array_equal(columns.generation[:10], 2 * columns.ids)


@pytest.mark.parametrize("ids", [[1, 1], [3, 1, 3]])
def test_ids_that_cannot_be(ids):
    with pytest.raises(InputError, match="comes twice"):
        Columns().restore(np.array(ids), 9)
