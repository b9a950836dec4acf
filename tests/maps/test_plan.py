"""Which rows are independent and which belong together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.models import NEW, NULL, ObservationModel, Observations
from rbpf.errors import InputError
from rbpf.maps.rows import Plan, Row, make_plan

N = 4
NUMBERS = np.array([0, 0, 0, 1, 1, 2, -1])
PLAIN = np.array([True, True, False])
HELD = [0, 1, 2, 3, 4, 5]


def kinds(ids):
    """Numbers of parametrisations; beyond them there is no landmark."""
    return np.where(ids < NUMBERS.size, NUMBERS[np.minimum(ids, NUMBERS.size - 1)], -1)


class Anything(ObservationModel):
    """A model that is not called."""

    dim = 1

    def predict(self, state, landmark=None, const=None, substate=None):
        raise AssertionError


def group(ids, **options) -> Observations:
    ids = np.array(ids)
    return Observations(np.zeros((ids.shape[-1], 1)), np.ones((ids.shape[-1], 1, 1)), Anything(), ids=ids, **options)


def rows_of(plan: Plan) -> list[Row]:
    """Every row of a plan, batches taken apart."""
    rows = [row for rows in plan.joint for row in rows] + list(plan.mixtures)
    for batch in plan.batches:
        for j, (k, landmark) in enumerate(zip(batch.ks.tolist(), batch.ids.tolist(), strict=True)):
            mask = None if batch.mask is None else batch.mask[:, j]
            rows.append(Row(batch.group, k, landmark, mask))
    return rows


def matrix(rows: list[Row], count: int, groups: int) -> np.ndarray:
    """Ids (groups, N, count) that rows speak of, −1 elsewhere."""
    out = np.full((groups, N, count), NULL)
    for row in rows:
        mask = np.ones(N, dtype=bool) if row.mask is None else row.mask
        assert (out[row.group, mask, row.k] == NULL).all()
        out[row.group, mask, row.k] = row.landmark
    return out


@st.composite
def id_arrays(draw):
    """Ids (K,) or (N, K); a landmark may be named several times."""
    count = draw(st.integers(1, 4))
    one = st.sampled_from([NULL, NEW, *HELD])
    per_particle = draw(st.booleans())
    shape = (N, count) if per_particle else (count,)
    flat = draw(st.lists(one, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
    return np.array(flat).reshape(shape)


@given(st.lists(id_arrays(), min_size=1, max_size=3))
def test_every_row_appears_once_and_overlaps_are_stacked(all_ids):
    plan = make_plan([group(ids) for ids in all_ids], N, kinds, PLAIN)
    count = max(ids.shape[-1] for ids in all_ids)
    found = matrix(rows_of(plan), count, len(all_ids))
    for g, ids in enumerate(all_ids):
        expected = np.broadcast_to(np.where(ids >= 0, ids, NULL), (N, ids.shape[-1]))
        np.testing.assert_array_equal(found[g, :, : ids.shape[-1]], expected)
    for batch in plan.batches:
        assert np.unique(kinds(batch.ids)).size == 1
        assert PLAIN[kinds(batch.ids[:1])[0]]
    assert all(not PLAIN[kinds(np.array([row.landmark]))[0]] for row in plan.mixtures)
    together = {rows[0].landmark for rows in plan.joint}
    assert all(len({row.landmark for row in rows}) == 1 for rows in plan.joint)
    for landmark in HELD[:5]:
        per_particle = (found == landmark).sum(axis=(0, 2))
        assert (landmark in together) == bool((per_particle > 1).any())


def test_impossible_clutter_only_counts_where_there_is_some():
    plan = make_plan([group([[NULL], [0], [0], [0]], log_clutter=-np.inf)], N, kinds, PLAIN)
    assert plan.log_factor.tolist() == [-np.inf, 0.0, 0.0, 0.0]


def test_the_common_case_is_one_batch_without_masks():
    plan = make_plan([group([2, NULL, 0, 1])], N, kinds, PLAIN)
    assert len(plan.batches) == 1
    assert plan.batches[0].ids.tolist() == [2, 0, 1]
    assert plan.batches[0].ks.tolist() == [0, 2, 3]
    assert plan.batches[0].mask is None
    same_in_all = make_plan([group([[2, 0]] * N)], N, kinds, PLAIN)
    assert [batch.mask for batch in same_in_all.batches] == [None]
    nothing = make_plan([group(np.zeros(0, dtype=int))], N, kinds, PLAIN)
    assert (nothing.batches, nothing.joint, nothing.mixtures) == ([], [], [])


@pytest.mark.parametrize("ids", [[6], [7], [[0]] * (N - 1) + [[6]]])
def test_landmarks_that_are_not_held(ids):
    with pytest.raises(InputError, match=r"names landmark [67], which the map does not hold"):
        make_plan([group(ids)], N, kinds, PLAIN)
