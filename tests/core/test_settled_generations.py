"""Of a generation from which one row has all descendants the rows are told without a walk through the ancestry."""

import numpy as np

from rbpf.core.genealogy import Lineage
from rbpf.kernels import forest


def test_a_settled_generation_is_climbed_to_once(monkeypatch):
    """However old it grows, and whatever is resampled since; one that is not settled is climbed to every time."""
    climbed, rows_at = [], forest.rows_at

    def counted(*arguments):
        climbed.append(arguments[4])
        return rows_at(*arguments)

    monkeypatch.setattr("rbpf.core.genealogy.forest.rows_at", counted)
    lineage = Lineage(4)
    for generation in range(3):
        lineage.retain(generation)
    copies = [np.arange(4)]
    for ancestors in ([0, 2, 2, 3], [1, 1, 2, 2], [0, 0, 3, 3], [0, 1, 1, 3]):
        lineage.advance(np.array(ancestors))
        copies = [rows[ancestors] for rows in copies] + [np.arange(4)]
        for generation in range(min(3, lineage.generation)):
            np.testing.assert_array_equal(lineage.rows(generation), copies[generation])
    # Generation 0 is settled by the second resampling: all descend from its row 2.
    assert climbed.count(0) == 2 and climbed.count(1) == 3 and climbed.count(2) == 2


def test_what_is_settled_is_forgotten_by_a_restoration():
    """A generation's number may mean another ancestry after a restoration."""
    lineage, other = Lineage(2), Lineage(2)
    for one, ancestors in ((lineage, [0, 0]), (other, [1, 1])):
        one.retain(0)
        one.advance(np.array(ancestors))
        np.testing.assert_array_equal(one.rows(0), ancestors)
    lineage.restore(other.arrays())
    lineage.take_up(0)
    np.testing.assert_array_equal(lineage.rows(0), [1, 1])
