"""Tables of columns that come and go, beside a dictionary."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.maps.store import Columns


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
