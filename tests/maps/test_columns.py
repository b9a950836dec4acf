"""Tables of columns that come and go, beside a dictionary."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.maps.columns import Columns


def filled(columns: Columns, count: int, model: dict[int, int]) -> None:
    """New columns; everything told of one is its id, or follows from it."""
    for _ in range(count):
        column = columns.add()
        row = columns.row(column)
        columns.fields[row], columns.generation[row] = column + 1, 2 * column
        columns.slab[row], columns.kind[row] = 3 * column, column % 3
        model[column] = column % 3


@given(st.lists(st.tuples(st.integers(0, 90), st.integers(0, 90), st.integers(0, 2**32 - 1)), max_size=8))
def test_as_a_dictionary(edits):
    columns, model, started = Columns(), dict[int, int](), 0
    for new, gone, seed in edits:
        filled(columns, new, model)
        started += new
        rng = np.random.default_rng(seed)
        removed = rng.choice(sorted(model), min(gone, len(model)), replace=False).astype(np.int64)
        columns.remove(np.sort(removed))
        for column in removed.tolist():
            del model[column]
        ids = np.array(sorted(model), dtype=np.int64)
        np.testing.assert_array_equal(columns.ids, ids)
        assert columns.started == started
        rows = columns.rows(ids)
        np.testing.assert_array_equal(rows, [columns.row(column) for column in model] if model else rows)
        np.testing.assert_array_equal(columns.fields[rows], ids + 1)
        np.testing.assert_array_equal(columns.generation[rows], 2 * ids)
        np.testing.assert_array_equal(columns.slab[rows], 3 * ids)
        asked = np.arange(-2, started + 3)
        np.testing.assert_array_equal(columns.held(asked), [column in model for column in asked.tolist()])
        np.testing.assert_array_equal(
            columns.kinds(asked), [model.get(column, -1) for column in asked.tolist()]
        )


def test_memory_follows_what_is_held():
    """A thousand columns at once; then one at a time for ever."""
    columns, model = Columns(), dict[int, int]()
    filled(columns, 1000, model)
    assert columns.fields.size == 1024
    columns.remove(np.arange(990))
    assert columns.fields.size == 64
    for oldest in range(990, 6000):
        filled(columns, 1, model)
        columns.remove(np.array([oldest]))
    assert columns.fields.size == 64 and columns.started == 6010
    np.testing.assert_array_equal(columns.ids, np.arange(6000, 6010))
    np.testing.assert_array_equal(columns.generation[:10], 2 * columns.ids)


@pytest.mark.parametrize("ids", [[3, 2], [1, 1], [-1, 2], [2, 9]])
def test_ids_that_cannot_be(ids):
    with pytest.raises(InputError, match="do not ascend"):
        Columns().restore(np.array(ids), 9)
