"""The catalogue read backwards."""

from rbpf.sensors.names import Names


def test_names_follow_the_catalogue():
    names, catalogue = Names(), {}
    assert names.ids(catalogue) == {}
    catalogue[3] = 17
    assert names.ids(catalogue) == {17: 3}
    catalogue[4] = 5
    assert names.ids(catalogue) == {17: 3, 5: 4}


def test_a_landmark_removed_and_one_started_again():
    """Equal sizes, but another last number: the name stands for the new one."""
    names, catalogue = Names(), {0: 10, 1: 11}
    assert names.ids(catalogue) == {10: 0, 11: 1}
    del catalogue[1]
    catalogue[2] = 11
    assert names.ids(catalogue) == {10: 0, 11: 2}
    del catalogue[0]
    assert names.ids(catalogue) == {11: 2}


def test_another_catalogue():
    """As after a checkpoint: of the same size and with the same last number."""
    names = Names()
    assert names.ids({0: 10, 1: 11}) == {10: 0, 11: 1}
    assert names.ids({0: 10, 1: 12}) == {10: 0, 12: 1}


def test_an_unchanged_catalogue_is_not_read_again():
    names, catalogue = Names(), {0: 10}
    assert names.ids(catalogue) is names.ids(catalogue)
