"""Numba only: insertion of beams into the grids of many particles, and the likelihood field of a scan.

A grid is an index (N, H, W) of tiles, −1 for none, and a pool (tiles, PLANES, TILE, TILE) of their cells.
Cell (x, y) of the world is floor(position / side); `origin` is the tile of index[:, 0, 0], as (y, x). A scan is `beams`
(K, 5): start and end point in the robot's frame [m], and weight. States are (N, 3) elements of SE(2), [θ, x, y].
"""

import math

import numpy as np
from numba import boolean, float32, float64, int32, njit, types, void

from rbpf.kernels.signature import CUBE, INDICES, MATRIX, VECTOR, in_parts

TILE = 32  #: Cells per side of a tile.
PLANES = 4  #: Of a tile: log-odds; number of beams ending in the cell; their mean position in it, x and y in [0, 1).
LOG_ODDS, ENDS, MEAN_X, MEAN_Y = range(PLANES)
FINE = 8  #: Positions in a cell, per axis, for which the field of an occupied cell is tabulated.

INDEX = types.Array(int32, 3, "C")
POOL = types.Array(float32, 4, "C")
STAMPS = types.Array(float32, 4, "C")
FIELDS = types.Array(float32, 3, "C")
TOUCHED = types.Array(boolean, 3, "C")


@njit(cache=True, error_model="numpy", inline="always")
def _first(a, d, pitch):
    """Along one axis: the cell of `a`, the line parameter at which a step `d` leaves it, and the parameter per cell."""
    cell = math.floor(a / pitch)
    if d > 0.0:
        return cell, ((cell + 1) * pitch - a) / d, pitch / d
    if d < 0.0:
        return cell, (cell * pitch - a) / d, -pitch / d
    return cell, np.inf, np.inf


@njit(cache=True, error_model="numpy", inline="always")
def _walk(x0, y0, x1, y1, pitch):
    """Grid traversal along a line (J. Amanatides and A. Woo 1987).

    Returns per axis the first cell, the direction, the parameter at the next cell and per cell; and how many cells follow the
    first.
    """
    x, next_x, more_x = _first(x0, x1 - x0, pitch)
    y, next_y, more_y = _first(y0, y1 - y0, pitch)
    steps = int(abs(math.floor(x1 / pitch) - x) + abs(math.floor(y1 / pitch) - y))
    return x, 1 if x1 > x0 else -1, next_x, more_x, y, 1 if y1 > y0 else -1, next_y, more_y, steps


@njit(cache=True, error_model="numpy", inline="always")
def _ends(state, beam):
    """Start and end point of a beam in the world [m]."""
    cos, sin = math.cos(state[0]), math.sin(state[0])
    return (
        state[1] + cos * beam[0] - sin * beam[1],
        state[2] + sin * beam[0] + cos * beam[1],
        state[1] + cos * beam[2] - sin * beam[3],
        state[2] + sin * beam[2] + cos * beam[3],
    )


@njit(void(MATRIX, MATRIX, float64, INDICES, TOUCHED), cache=True, error_model="numpy")
def touch(state, beams, side, origin, touched):
    """Marks the tiles (N, H, W) that the beams cross, from end to end."""
    pitch = side * TILE
    for n in range(state.shape[0]):
        for k in range(beams.shape[0]):
            x0, y0, x1, y1 = _ends(state[n], beams[k])
            x, step_x, next_x, more_x, y, step_y, next_y, more_y, steps = _walk(x0, y0, x1, y1, pitch)
            touched[n, int(y) - origin[0], int(x) - origin[1]] = True
            for _ in range(steps):
                if next_x < next_y:
                    x += step_x
                    next_x += more_x
                else:
                    y += step_y
                    next_y += more_y
                touched[n, int(y) - origin[0], int(x) - origin[1]] = True


@njit(void(TOUCHED, INDEX, INDICES, POOL, INDICES), cache=True, error_model="numpy")
def own(touched, index, users, pool, free):
    """Copy-on-write: gives every particle its own tile wherever it will write, a copy of a shared one or an empty one."""
    taken = 0
    for n in range(index.shape[0]):
        for y in range(index.shape[1]):
            for x in range(index.shape[2]):
                if not touched[n, y, x]:
                    continue
                tile = index[n, y, x]
                if tile >= 0 and users[tile] == 1:
                    continue
                new = free[taken]
                taken += 1
                cells = pool[new].reshape(PLANES * TILE * TILE)
                if tile < 0:
                    cells[:] = 0.0
                else:
                    inherited = pool[tile].reshape(cells.size)
                    for i in range(cells.size):
                        cells[i] = inherited[i]
                    users[tile] -= 1
                users[new] = 1
                index[n, y, x] = new


@njit(cache=True, error_model="numpy", inline="always")
def _tile_of(index, n, origin, x, y):
    """The tile of a cell, −1 for none."""
    row, column = (y // TILE) - origin[0], (x // TILE) - origin[1]
    if row < 0 or column < 0 or row >= index.shape[1] or column >= index.shape[2]:
        return -1
    return index[n, row, column]


@in_parts(MATRIX, MATRIX, float64, INDICES, INDEX, POOL, VECTOR)
def insert(n, arguments):
    """Inserts a scan into unshared tiles; arguments (state, beams, side, origin, index, pool, change); parts are particles.

    `change` has the log-odds increments of an end and of a crossing, and the bound.
    """
    state, beams, side, origin, index, pool, change = arguments
    hit, miss, bound = change[0], change[1], change[2]
    # Crossings first, so that walls passed by grazing beams are restored by the ends of the same scan.
    for k in range(beams.shape[0]):
        x0, y0, x1, y1 = _ends(state[n], beams[k])
        x, step_x, next_x, more_x, y, step_y, next_y, more_y, steps = _walk(x0, y0, x1, y1, side)
        for _ in range(steps):
            cx, cy = int(x), int(y)
            tile = _tile_of(index, n, origin, cx, cy)
            if tile >= 0:
                cell = pool[tile, LOG_ODDS, cy % TILE, cx % TILE]
                pool[tile, LOG_ODDS, cy % TILE, cx % TILE] = max(cell - miss, -bound)
            if next_x < next_y:
                x += step_x
                next_x += more_x
            else:
                y += step_y
                next_y += more_y
    for k in range(beams.shape[0]):
        _, _, x1, y1 = _ends(state[n], beams[k])
        cx, cy = math.floor(x1 / side), math.floor(y1 / side)
        tile = _tile_of(index, n, origin, cx, cy)
        if tile >= 0:
            row, column = cy % TILE, cx % TILE
            pool[tile, LOG_ODDS, row, column] = min(pool[tile, LOG_ODDS, row, column] + hit, bound)
            count = pool[tile, ENDS, row, column] + 1.0
            pool[tile, ENDS, row, column] = count
            pool[tile, MEAN_X, row, column] += (x1 / side - cx - pool[tile, MEAN_X, row, column]) / count
            pool[tile, MEAN_Y, row, column] += (y1 / side - cy - pool[tile, MEAN_Y, row, column]) / count


@njit(cache=True, error_model="numpy")
def _mark(marked, window, state, beams, side, turn, margin):
    """Marks the window's tiles within `margin` [m] of possible beam ends, for heading errors up to ±`turn`."""
    pitch = side * TILE
    reach = 0.0
    for k in range(beams.shape[0]):
        reach = max(reach, math.hypot(beams[k, 2], beams[k, 3]))
    count = math.ceil(turn * reach / (0.5 * pitch))
    guess = state.copy()
    for j in range(-count, count + 1):
        guess[0] = state[0] + turn * j / max(count, 1)
        for k in range(beams.shape[0]):
            _, _, x, y = _ends(guess, beams[k])
            left, right = math.floor((x - margin) / pitch), math.floor((x + margin) / pitch)
            low, high = math.floor((y - margin) / pitch), math.floor((y + margin) / pitch)
            for row in range(max(low - window[0], 0), min(high - window[0] + 1, marked.shape[0])):
                for column in range(max(left - window[1], 0), min(right - window[1] + 1, marked.shape[1])):
                    marked[row, column] = True


@njit(cache=True, error_model="numpy")
def _build(field, marked, window, n, origin, index, pool, stamps):
    """Fills the marked tiles of the field: at each cell's centre, the highest stamp of the occupied cells nearby."""
    width = stamps.shape[2]
    for row in range(marked.shape[0]):
        for column in range(marked.shape[1]):
            y, x = row + window[0] - origin[0], column + window[1] - origin[1]
            if not marked[row, column] or y < 0 or x < 0 or y >= index.shape[1] or x >= index.shape[2]:
                continue
            tile = index[n, y, x]
            if tile < 0:
                continue
            for b in range(TILE):
                for a in range(TILE):
                    if pool[tile, LOG_ODDS, b, a] <= 0.0:
                        continue
                    fine_y = min(int(pool[tile, MEAN_Y, b, a] * FINE), FINE - 1)
                    fine_x = min(int(pool[tile, MEAN_X, b, a] * FINE), FINE - 1)
                    # The field has a border of half a stamp, so that stamps always fit.
                    for v in range(width):
                        target = field[row * TILE + b + v]
                        for u in range(width):
                            value = stamps[fine_y, fine_x, v, u]
                            if value > target[column * TILE + a + u]:
                                target[column * TILE + a + u] = value


@njit(cache=True, error_model="numpy", inline="always")
def _prepare(n, state, beams, turn, margin, side, origin, index, pool, stamps, field, marked, window):
    """The field around possible beam ends of one particle, in a window of tiles around its state."""
    pitch, tiles = side * TILE, marked.shape[0]
    window[0] = math.floor(state[2] / pitch) - tiles // 2
    window[1] = math.floor(state[1] / pitch) - tiles // 2
    _mark(marked, window, state, beams, side, turn, margin)
    _build(field, marked, window, n, origin, index, pool, stamps)


@njit(cache=True, error_model="numpy")
def _clear(field, marked, border):
    """Undoes `_mark` and `_build`."""
    for row in range(marked.shape[0]):
        for column in range(marked.shape[1]):
            if marked[row, column]:
                low, left = row * TILE, column * TILE
                field[low : low + TILE + 2 * border, left : left + TILE + 2 * border] = 0.0
                marked[row, column] = False


@njit(cache=True, error_model="numpy")
def _score(field, window, border, side, x, y, cos, sin, beams):
    """Σ of weight · field at the beams' ends, interpolated between the centres of cells."""
    rows, columns = field.shape
    total = 0.0
    left, low = window[1] * TILE - border + 0.5, window[0] * TILE - border + 0.5
    for k in range(beams.shape[0]):
        px = (x + cos * beams[k, 2] - sin * beams[k, 3]) / side - left
        py = (y + sin * beams[k, 2] + cos * beams[k, 3]) / side - low
        if px < 0.0 or py < 0.0 or px >= columns - 1 or py >= rows - 1:
            continue
        column, row = int(px), int(py)
        u, v = px - column, py - row
        below = (1.0 - u) * field[row, column] + u * field[row, column + 1]
        above = (1.0 - u) * field[row + 1, column] + u * field[row + 1, column + 1]
        total += beams[k, 4] * ((1.0 - v) * below + v * above)
    return total


@njit(cache=True, error_model="numpy", inline="always")
def _penalty(info, increment):
    """½ εᵀ info ε."""
    total = 0.0
    for a in range(3):
        for b in range(3):
            total += increment[a] * info[a, b] * increment[b]
    return 0.5 * total


@njit(cache=True, error_model="numpy")
def _value(field, window, border, side, base, increment, beams, state):
    """The score at base · Exp(increment) in SE(2), which is written to `state`."""
    half = 0.5 * increment[0]
    sinc = 1.0 if abs(half) < 1e-8 else math.sin(half) / half
    cos, sin = sinc * math.cos(base[0] + half), sinc * math.sin(base[0] + half)
    state[0] = base[0] + increment[0]
    state[1] = base[1] + cos * increment[1] - sin * increment[2]
    state[2] = base[2] + sin * increment[1] + cos * increment[2]
    return _score(field, window, border, side, state[1], state[2], math.cos(state[0]), math.sin(state[0]), beams)


@njit(cache=True, error_model="numpy")
def _second_order(field, window, border, side, base, at, beams, steps, state, gradient, hessian):
    """Value, gradient (3,) and Hessian (3, 3) of the score by differences over `steps` (3,), wider than a cell."""
    there = at.copy()
    value = _value(field, window, border, side, base, at, beams, state)
    for a in range(3):
        there[a] = at[a] + steps[a]
        up = _value(field, window, border, side, base, there, beams, state)
        there[a] = at[a] - steps[a]
        down = _value(field, window, border, side, base, there, beams, state)
        there[a] = at[a]
        gradient[a] = (up - down) / (2.0 * steps[a])
        hessian[a, a] = (up - 2.0 * value + down) / steps[a] ** 2
    for a in range(3):
        for b in range(a):
            mixed = 0.0
            for i in (-1, 1):
                for j in (-1, 1):
                    there[a], there[b] = at[a] + i * steps[a], at[b] + j * steps[b]
                    mixed += i * j * _value(field, window, border, side, base, there, beams, state)
            there[a], there[b] = at[a], at[b]
            hessian[a, b] = hessian[b, a] = mixed / (4.0 * steps[a] * steps[b])
    return value


#: Types of `place` = (state, beams, side, origin, index, pool, stamps, fields, marks); one field and marks per thread, all
#: zero.
PLACE = MATRIX, MATRIX, float64, INDICES, INDEX, POOL, STAMPS, FIELDS, TOUCHED


@in_parts(*PLACE, VECTOR)
def scores(thread, arguments):
    """Σ of weight · field, value (N,), at the states; parts are threads."""
    state, beams, side, origin, index, pool, stamps, fields, marks, value = arguments
    border = stamps.shape[2] // 2
    threads = fields.shape[0]
    field, marked, window = fields[thread], marks[thread], np.zeros(2, dtype=np.int64)
    for n in range(thread, state.shape[0], threads):
        margin = (border + 1) * side
        _prepare(n, state[n], beams, 0.0, margin, side, origin, index, pool, stamps, field, marked, window)
        cos, sin = math.cos(state[n, 0]), math.sin(state[n, 0])
        value[n] = _score(field, window, border, side, state[n, 1], state[n, 2], cos, sin, beams)
        _clear(field, marked, border)


@njit(cache=True, error_model="numpy", inline="always")
def _outward(k):
    """The integers in the order 0, 1, −1, 2, −2."""
    return (k + 1) // 2 if k % 2 else -(k // 2)


@njit(cache=True, error_model="numpy")
def _copy(values, out):
    """Copies three numbers; a slice would also compile shape checks."""
    out[0], out[1], out[2] = values[0], values[1], values[2]


@in_parts(*PLACE, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, VECTOR, MATRIX, VECTOR, CUBE)
def search(thread, arguments):
    """Finds the increments (N, 3) that maximise score − ½ εᵀ info ε within ±`radius` (3,) of the states.

    Arguments are a `place`, (info, radius, spacing, steps, few, rest) and the output; parts are threads. First a lattice
    search with `spacing` (3,), from the centre outward, by nearest cells for the beams `few`: `rest` bounds the score of the
    remaining beams, so that most points are rejected early. Then, from the best point, an axis search with halved steps (G.
    Grisetti et al. 2007).
    """
    state, beams, side, origin, index, pool, stamps, fields, marks = arguments[:9]
    info, radius, spacing, steps, few, rest, increment, value, hessian = arguments[9:]
    border = stamps.shape[2] // 2
    threads = fields.shape[0]
    field, marked, window = fields[thread], marks[thread], np.zeros(2, dtype=np.int64)
    there, best, trial, gradient = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    counts = np.zeros(3, dtype=np.int64)
    for a in range(3):
        counts[a] = math.ceil(radius[a] / spacing[a])
    ends = np.zeros((few.shape[0], 2))
    for n in range(thread, state.shape[0], threads):
        base, turn = state[n], radius[0] + spacing[0]
        margin = (border + 1) * side + math.hypot(radius[1] + spacing[1], radius[2] + spacing[2])
        _prepare(n, base, beams, turn, margin, side, origin, index, pool, stamps, field, marked, window)
        left, low = window[1] * TILE - border, window[0] * TILE - border
        highest = -np.inf
        for i in range(2 * counts[0] + 1):
            trial[0] = _outward(i) * spacing[0]
            cos, sin = math.cos(base[0] + trial[0]), math.sin(base[0] + trial[0])
            for k in range(few.shape[0]):
                beam = few[k]
                ends[k, 0] = (base[1] + cos * beam[2] - sin * beam[3]) / side - left
                ends[k, 1] = (base[2] + sin * beam[2] + cos * beam[3]) / side - low
            # Translations are along the robot's axes at half the rotation, the direction of the chord of Exp.
            half = 0.5 * trial[0]
            chord = 1.0 if abs(half) < 1e-8 else math.sin(half) / half
            cos, sin = chord * math.cos(base[0] + half) / side, chord * math.sin(base[0] + half) / side
            for j in range(2 * counts[1] + 1):
                trial[1] = _outward(j) * spacing[1]
                for m in range(2 * counts[2] + 1):
                    trial[2] = _outward(m) * spacing[2]
                    shift_x = cos * trial[1] - sin * trial[2]
                    shift_y = sin * trial[1] + cos * trial[2]
                    total = -_penalty(info, trial)
                    for k in range(few.shape[0]):
                        if total + rest[k] <= highest:
                            break
                        column, row = int(ends[k, 0] + shift_x), int(ends[k, 1] + shift_y)
                        if 0 <= column < field.shape[1] and 0 <= row < field.shape[0]:
                            total += few[k, 4] * field[row, column]
                    if total > highest:
                        highest = total
                        _copy(trial, best)
        # Hill climbing from there.
        highest = _value(field, window, border, side, base, best, beams, there) - _penalty(info, best)
        scale = 0.5
        while scale > 0.01:
            moved = False
            for a in range(3):
                for sign in (-1.0, 1.0):
                    _copy(best, trial)
                    trial[a] += sign * scale * spacing[a]
                    if abs(trial[a]) > radius[a] + spacing[a]:
                        continue
                    total = _value(field, window, border, side, base, trial, beams, there) - _penalty(info, trial)
                    if total > highest:
                        highest = total
                        _copy(trial, best)
                        moved = True
            if not moved:
                scale *= 0.5
        _copy(best, increment[n])
        value[n] = _second_order(field, window, border, side, base, best, beams, steps, there, gradient, hessian[n])
        _clear(field, marked, border)
