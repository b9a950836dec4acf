"""The catalogue read backwards."""

import numpy as np

from rbpf.sensors.catalogue_index import NameIndex, NumberIndex


def test_names_follow_the_catalogue():
    names, catalogue = NameIndex(), {}
    assert names.ids(catalogue) == {}
    catalogue[3] = 17
    assert names.ids(catalogue) == {17: 3}
    catalogue[4] = 5
    assert names.ids(catalogue) == {17: 3, 5: 4}


def test_a_landmark_removed_and_one_started_again():
    """Equal sizes, but another last number: the name stands for the new one."""
    names, catalogue = NameIndex(), {0: 10, 1: 11}
    assert names.ids(catalogue) == {10: 0, 11: 1}
    del catalogue[1]
    catalogue[2] = 11
    assert names.ids(catalogue) == {10: 0, 11: 2}
    del catalogue[0]
    assert names.ids(catalogue) == {11: 2}


def test_another_catalogue():
    """As after a checkpoint: of the same size and with the same last number."""
    names = NameIndex()
    assert names.ids({0: 10, 1: 11}) == {10: 0, 11: 1}
    assert names.ids({0: 10, 1: 12}) == {10: 0, 12: 1}


def test_an_unchanged_catalogue_is_not_read_again():
    names, catalogue = NameIndex(), {0: 10}
    assert names.ids(catalogue) is names.ids(catalogue)


def test_numbers_follow_the_catalogue():
    """Names as they come, ids that a removal leaves apart, more names than there was room for."""
    numbers, catalogue = NumberIndex(), {0: 5, 1: 3}
    np.testing.assert_array_equal(numbers.ids(catalogue, np.array([3, 5, 4])), [1, 0, -1])
    del catalogue[0]
    catalogue |= {7: 900, 9: 4}
    np.testing.assert_array_equal(numbers.ids(catalogue, np.array([900, 4, 3])), [7, 9, 1])


def test_numbers_read_only_what_is_new():
    class Counting(dict):
        reads = 0

        def __getitem__(self, key):
            Counting.reads += 1
            return super().__getitem__(key)

    numbers, catalogue = NumberIndex(), Counting({k: k for k in range(500)})
    numbers.ids(catalogue, np.array([499]))
    assert Counting.reads == 500
    del catalogue[3]
    catalogue[500] = 500
    np.testing.assert_array_equal(numbers.ids(catalogue, np.array([500, 2])), [500, 2])
    assert Counting.reads == 501
