"""Compiled choice of corners, see `rbpf.sensors.features.corners`."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def peaks(scores, places, least, kept):
    """Fills kept (M,): whether the score at a place (M, 2) is at least `least` and at no neighbouring place higher.

    The places are whole pixels inside the outermost ones.
    """
    rated = np.zeros(scores.shape, np.bool_)
    for m in range(places.shape[0]):
        rated[places[m, 1], places[m, 0]] = scores[places[m, 1], places[m, 0]] >= least
    for m in range(places.shape[0]):
        u, v = places[m, 0], places[m, 1]
        kept[m] = rated[v, u]
        for y in range(v - 1, v + 2):
            for x in range(u - 1, u + 2):
                if rated[y, x] and scores[y, x] > scores[v, u]:
                    kept[m] = False


@njit(cache=True, error_model="numpy")
def spread(places, order, occupied, spacing, chosen):
    """Fills `chosen` with the first of `order` that keep their distance from each other and from `occupied`.

    Returns how many were chosen. A distance equal to the spacing is far enough.
    """
    taken = np.empty((occupied.shape[0] + chosen.shape[0], 2))
    taken[: occupied.shape[0]] = occupied
    found = 0
    for m in order:
        if found == chosen.shape[0]:
            break
        place = taken[occupied.shape[0] + found]
        place[:] = places[m]
        if _is_free(place, taken[: occupied.shape[0] + found], spacing):
            chosen[found] = m
            found += 1
    return found


@njit(cache=True, error_model="numpy")
def _is_free(place, taken, spacing):
    for other in taken:
        du, dv = place[0] - other[0], place[1] - other[1]
        if du * du + dv * dv < spacing * spacing:
            return False
    return True
