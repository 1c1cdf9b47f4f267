"""Lookup of contacts on the CPU, compiled by numba; ../lookup.py defines it.

The nearest are found by cells: particles are sorted, along the two axes in which they are spread
widest, into cells as wide as the search radius, and compared with those in the same cell and the
next.
"""

from math import sqrt
from typing import no_type_check  # numba needs functions as they are, not wrapped in checks

import numpy as np
from numba import njit

from jaxsimp.dynamics.contact.cpu.foreign import compiled

LANES = 16
"""Particles that are compared at a time."""
DE_BRUIJN = np.uint32(0x077CB531)
"""Any five bits of it in a row are other than any other five: shifts of it tell single bits."""
BIT_PLACES = np.empty(32, np.int64)
BIT_PLACES[[(int(DE_BRUIJN) << place & 0xFFFFFFFF) >> 27 for place in range(32)]] = range(32)
TINY = np.float32(1e-20)
"""Squared length below which a vector has no direction."""
FAR = np.float32(1e4)
"""What is farther away than this, metres, has no say in where cells are."""


@compiled
@no_type_check
def gone_too_far(position, found_at, allowance):
    """Whether any has, from where it was found, or from there moved along with the others.

    What all have in common brings none nearer to another. Where some move and some lie still,
    half of it is common to all.
    """
    zero = allowance.dtype.type(0)
    if not _any_beyond(position, found_at, allowance, zero, zero, zero):
        return False
    x, y, z = (
        _middle_of_moves(position[0], found_at[0]),
        _middle_of_moves(position[1], found_at[1]),
        _middle_of_moves(position[2], found_at[2]),
    )
    return _any_beyond(position, found_at, allowance, x, y, z)


@njit(inline="always")
@no_type_check
def _any_beyond(position, found_at, allowance, common_x, common_y, common_z):
    beyond = False
    for i in range(len(allowance)):
        x, y, z = (
            position[0][i] - found_at[0, i] - common_x,
            position[1][i] - found_at[1, i] - common_y,
            position[2][i] - found_at[2, i] - common_z,
        )
        beyond |= not x * x + y * y + z * z <= allowance[i] * abs(allowance[i])
    return beyond


@njit(inline="always")
@no_type_check
def _middle_of_moves(position, found_at):
    """Half way between the least and the greatest, along an axis."""
    least = greatest = position[0] - found_at[0]
    for i in range(1, len(position)):
        move = position[i] - found_at[i]
        least, greatest = min(least, move), max(greatest, move)
    return (least + greatest) / 2


@compiled
@no_type_check
def find_pairs(
    position,
    partner,
    listed_by,
    direction,
    found_at,
    allowance,
    numbers,
    frame,
    apart,
    is_sheet,
):
    """Look up the nearest on either side of each, and the directions of their contacts."""
    real = position[0].dtype.type
    count = len(position[0])
    adjacent, slack = numbers[0] * numbers[0], numbers[3]
    squash, level, touching, reach = numbers[4], numbers[8], numbers[9], numbers[10]
    search, half = numbers[11], real(0.5)
    order, start, rows, columns = _sorted_into_cells(position, search)
    across, known = np.empty((count, 3), real), np.zeros(count, np.bool_)
    farthest = search * search
    clear = np.full(count, farthest, real)
    nearest = np.full((count, 2), reach * reach, real)
    best = np.empty((count, 2), np.uint32)
    points = np.full((6, count + LANES), real(np.nan))  # After the last: near to nothing.
    for place in range(count):
        i = order[place]
        best[i, 0] = best[i, 1] = i
        for axis in range(3):
            points[axis, place] = position[axis][i]
            points[3 + axis, place] = apart[axis, i]
    # Each pair is met in the row of one that comes later, or in the next row.
    for row in range(rows):
        for column in range(columns):
            cell = row * columns + column
            begin, end = max(column - 1, 0), min(column + 2, columns)
            last = start[row * columns + end]
            next_first, next_last = 0, 0
            if row + 1 < rows:
                next_first = start[(row + 1) * columns + begin]
                next_last = start[(row + 1) * columns + end]
            for place in range(start[cell], start[cell + 1]):
                for part in range(2):
                    low, high = (place + 1, last) if part == 0 else (next_first, next_last)
                    for block in range(low, high, LANES):
                        near = _near(points, place, block, farthest, adjacent)
                        while near:
                            lane = _lowest(near)
                            near &= near - np.uint32(1)
                            other = block + lane
                            x = points[0, other] - points[0, place]
                            y = points[1, other] - points[1, place]
                            z = points[2, other] - points[2, place]
                            squared = x * x + y * y + z * z
                            i, j = order[place], order[other]
                            clear[i], clear[j] = min(clear[i], squared), min(clear[j], squared)
                            if squared >= reach * reach:
                                continue
                            for each in (i, j):
                                if not known[each]:
                                    known[each] = True
                                    across[each] = _across(each, position, frame, is_sheet)
                            _compare(
                                i, j, x, y, z, squared, across, is_sheet, numbers, nearest, best
                            )
                            _compare(
                                j, i, -x, -y, -z, squared, across, is_sheet, numbers, nearest, best
                            )
    stretch = sqrt(real(1) + squash)
    for i in range(count):
        closest = sqrt(min(nearest[i, 0], nearest[i, 1]))
        # What is beside a particle may come nearer by its distance, what is above by less.
        free = max((closest - touching) / stretch, sqrt(clear[i]) - touching)
        allowance[i] = max(slack, half * free)
        for axis in range(3):
            found_at[axis, i] = position[axis][i]
    _list_pairs(position, best, across, partner, listed_by, direction, level, is_sheet)


@compiled
@no_type_check
def _list_pairs(position, best, across, partner, listed_by, direction, level, is_sheet):
    """List each particle and its nearest on a side, each pair once, with its direction."""
    count, capacity = len(best), len(listed_by)
    num_listings = np.zeros(count, np.int64)
    listed_by[:] = 2 * count
    for i in range(count):
        above, below = best[i, 0], best[i, 1]
        for k in range(2):
            j = best[i, k]
            # Not those that have been met from the other side.
            met = j < i and (best[j, 0] == i or best[j, 1] == i)
            partner[k, i] = i
            direction[0, k, i], direction[1, k, i], direction[2, k, i] = 0, 0, 1
            if j == i or met or (k == 1 and below == above) or num_listings[j] == capacity:
                continue
            partner[k, i] = j
            listed_by[num_listings[j], j] = k * count + i
            num_listings[j] += 1
            _direct(i, j, k, position, across, is_sheet, level, direction)


@njit(inline="always")
@no_type_check
def _near(points, place, block, farthest, adjacent):
    """Which of a block a particle may come to touch, as bits.

    All at a time: with unsigned indices and a fixed count, and only then, LLVM makes vectors.
    """
    at, first = np.uintp(place), np.uintp(block)
    x, y, z = points[0, at], points[1, at], points[2, at]
    u, v, w = points[3, at], points[4, at], points[5, at]
    near = np.uint32(0)
    for lane in range(LANES):
        other = first + np.uintp(lane)
        dx, dy, dz = points[0, other] - x, points[1, other] - y, points[2, other] - z
        du, dv, dw = points[3, other] - u, points[4, other] - v, points[5, other] - w
        is_near = dx * dx + dy * dy + dz * dz < farthest
        is_near &= du * du + dv * dv + dw * dw >= adjacent
        near |= np.uint32(is_near) << np.uint32(lane)
    return near


@njit(inline="always")
@no_type_check
def _lowest(bits):
    """The place of the lowest bit that is set."""
    alone = bits & (~bits + np.uint32(1))
    return BIT_PLACES[(alone * DE_BRUIJN & np.uint32(0xFFFFFFFF)) >> np.uint32(27)]


@compiled
@no_type_check
def _sorted_into_cells(position, width):
    """Particles by cell along the two widest axes, where those of a cell begin, and the shape."""
    count = len(position[0])
    real = position[0].dtype.type
    lows, extents = np.empty(3, real), np.empty(3, real)
    for axis in range(3):
        least, most = real(FAR), real(-FAR)
        for at in position[axis]:
            if -FAR < at < FAR:
                least, most = min(least, at), max(most, at)
        lows[axis], extents[axis] = least, max(most - least, real(0))
    narrowest = np.argmin(extents)
    first, second = (narrowest + 1) % 3, (narrowest + 2) % 3
    # No more cells than a few for each particle: what has flown apart gets wider ones.
    rows, columns = 1 + int(extents[first] / width), 1 + int(extents[second] / width)
    while rows * columns > 4 * count + 64:
        width *= 2
        rows, columns = 1 + int(extents[first] / width), 1 + int(extents[second] / width)
    scale, down, along = np.float32(1) / width, position[first], position[second]
    start = np.zeros(rows * columns + 1, np.int64)
    cell_of, order = np.empty(count, np.uint32), np.empty(count, np.uint32)
    for i in range(count):
        row = _cell(down[i] - lows[first], scale, rows)
        cell_of[i] = row * columns + _cell(along[i] - lows[second], scale, columns)
        start[cell_of[i] + np.uint32(1)] += 1
    for cell in range(rows * columns):
        start[cell + 1] += start[cell]
    # From the end of each cell down: it is then where the cell begins, one place too far.
    for i in range(count - 1, -1, -1):
        after = cell_of[i] + np.uint32(1)
        start[after] -= 1
        order[start[after]] = i
    for cell in range(rows * columns):
        start[cell] = start[cell + 1]
    start[rows * columns] = count
    return order, start, rows, columns


@njit(inline="always")
@no_type_check
def _cell(along, scale, cells):
    """The cell along an axis; the first for what is not a number, the last beyond the end."""
    share = along * scale
    if share >= cells:
        return cells - 1
    return int(share) if share >= 0 else 0


@njit(inline="always")
@no_type_check
def _across(i, position, frame, is_sheet):
    """Unit normal of the sheet, or tangent of the rope, at a particle."""
    real = position[0].dtype.type
    a, b, c, d = frame[0, i], frame[1, i], frame[2, i], frame[3, i]
    x = position[0][a] - position[0][b]
    y = position[1][a] - position[1][b]
    z = position[2][a] - position[2][b]
    if is_sheet:
        u = position[0][c] - position[0][d]
        v = position[1][c] - position[1][d]
        w = position[2][c] - position[2][d]
        x, y, z = y * w - z * v, z * u - x * w, x * v - y * u
    return _unit(x, y, z, real(0), real(0), real(1))


@njit(inline="always")
@no_type_check
def _unit(x, y, z, otherwise_x, otherwise_y, otherwise_z):
    squared = x * x + y * y + z * z
    if squared > TINY:
        scale = np.float32(1) / sqrt(squared)
        return x * scale, y * scale, z * scale
    return otherwise_x, otherwise_y, otherwise_z


@njit(inline="always")
@no_type_check
def _compare(i, j, dx, dy, dz, squared, across, is_sheet, numbers, nearest, best):
    """Whether j, at (dx, dy, dz) of i, is the nearest so far on one side of i, or on both."""
    # Around a rope there is room for more: its sides are above and below.
    above = across[i, 0] * dx + across[i, 1] * dy + across[i, 2] * dz if is_sheet else dz
    squash, level = numbers[4], numbers[8]
    squared = squared + squash * above * above
    # Selections, not branches: which way they go is anybody's guess.
    is_best = (above >= -level) & (squared < nearest[i, 0])
    nearest[i, 0] = squared if is_best else nearest[i, 0]
    best[i, 0] = j if is_best else best[i, 0]
    is_best = (above <= level) & (squared < nearest[i, 1])
    nearest[i, 1] = squared if is_best else nearest[i, 1]
    best[i, 1] = j if is_best else best[i, 1]


@compiled
@no_type_check
def _direct(i, j, k, position, across, is_sheet, level, direction):
    """The direction of a contact, see directions.py."""
    real = position[0].dtype.type
    zero, one = real(0), real(1)
    dx = position[0][i] - position[0][j]
    dy = position[1][i] - position[1][j]
    dz = position[2][i] - position[2][j]
    sx, sy, sz = _unit(dx, dy, dz, zero, zero, one)
    x, y, z = sx, sy, sz
    mx, my, mz = across[i, 0], across[i, 1], across[i, 2]
    yx, yy, yz = across[j, 0], across[j, 1], across[j, 2]
    if is_sheet:
        above = mx * dx + my * dy + mz * dz
        below = yx * dx + yy * dy + yz * dz
        p = -one if above < zero else one
        q = -one if below < zero else one
        bx, by, bz = p * mx + q * yx, p * my + q * yy, p * mz + q * yz
        beside = max(abs(above), abs(below)) < level
        if not beside and bx * bx + by * by + bz * bz >= one:
            x, y, z = _unit(bx, by, bz, sx, sy, sz)
    else:
        along = mx * dx + my * dy + mz * dz
        dx, dy, dz = dx - along * mx, dy - along * my, dz - along * mz
        along = mx * yx + my * yy + mz * yz
        yx, yy, yz = yx - along * mx, yy - along * my, yz - along * mz
        turned = yx * yx + yy * yy + yz * yz
        if turned > real(0.05):
            part = (yx * dx + yy * dy + yz * dz) / turned
            dx, dy, dz = dx - part * yx, dy - part * yy, dz - part * yz
        if dx * dx + dy * dy + dz * dz >= level * level:
            x, y, z = _unit(dx, dy, dz, sx, sy, sz)
    direction[0, k, i], direction[1, k, i], direction[2, k, i] = x, y, z
