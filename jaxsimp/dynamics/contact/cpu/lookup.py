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
from jaxsimp.dynamics.contact.settings import ALONE, FEW

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


@njit(inline="always")
@no_type_check
def look_up(
    position,
    nearest,
    distance,
    partner,
    listed_by,
    direction,
    found_at,
    allowance,
    renewed,
    numbers,
    sizes,
    frame,
    adjacent,
    is_sheet,
):
    """Look up the particles that moved too far, or all; list pairs, and find their directions."""
    renewed[:] = False
    real, count = position[0].dtype.type, len(allowance)
    alone = _num_beyond(position, found_at, allowance, real(0), real(0), real(0))
    if alone == 0:
        return
    due, is_due = np.empty(count, np.uint32), np.empty(count, np.bool_)
    num_due = _find_due(position, found_at, allowance, alone, due, is_due)
    if num_due == 0:
        return
    if num_due > ALONE or num_due * FEW > count:
        across, known = _find_all(
            position,
            nearest,
            distance,
            found_at,
            allowance,
            numbers,
            sizes,
            frame,
            adjacent,
            is_sheet,
        )
        is_due[:] = True
        changed = True
    else:
        changed, across, known = _find_some(
            due[:num_due],
            is_due,
            position,
            nearest,
            distance,
            found_at,
            allowance,
            numbers,
            sizes,
            frame,
            adjacent,
            is_sheet,
        )
    if changed:
        _list_pairs(nearest, partner, listed_by, renewed)
    level = numbers[4]
    for k in range(2):
        for i in range(count):
            j = partner[k, i]
            if j != i and (renewed[k, i] | is_due[i] | is_due[j]):
                renewed[k, i] = True
                if not known[i]:
                    _find_across(i, position, frame, is_sheet, across, known)
                if not known[j]:
                    _find_across(j, position, frame, is_sheet, across, known)
                _direct(i, j, k, position, across, is_sheet, level, direction)


@njit(inline="always")
@no_type_check
def _find_due(position, found_at, allowance, alone, due, is_due):
    """List and mark those that moved too far, see ../lookup.py; returns their number.

    `alone` is the number of those that moved too far by themselves.
    """
    x, y, z = (
        _middle_of_moves(position[0], found_at[0]),
        _middle_of_moves(position[1], found_at[1]),
        _middle_of_moves(position[2], found_at[2]),
    )
    zero, number = allowance.dtype.type(0), np.uint32(0)
    along = _num_beyond(position, found_at, allowance, x, y, z)
    if along == 0:
        return number
    if along >= alone:
        x, y, z = zero, zero, zero
    for place in range(len(allowance)):
        i = np.uint32(place)
        found_at[0, i] += x
        found_at[1, i] += y
        found_at[2, i] += z
        dx, dy, dz = (
            position[0][i] - found_at[0, i],
            position[1][i] - found_at[1, i],
            position[2][i] - found_at[2, i],
        )
        is_due[i] = not dx * dx + dy * dy + dz * dz <= allowance[i] * abs(allowance[i])
        due[number] = i
        number += np.uint32(is_due[i])
    return number


@compiled
@no_type_check
def _num_beyond(position, found_at, allowance, common_x, common_y, common_z):
    """Number of particles that moved farther than allowed, apart from what all moved."""
    number = np.int32(0)
    for i in range(len(allowance)):
        x, y, z = (
            position[0][i] - found_at[0, i] - common_x,
            position[1][i] - found_at[1, i] - common_y,
            position[2][i] - found_at[2, i] - common_z,
        )
        number += np.int32(not x * x + y * y + z * z <= allowance[i] * abs(allowance[i]))
    return number


@compiled
@no_type_check
def _middle_of_moves(position, found_at):
    """Half way between the least and the greatest, along an axis."""
    count = len(position)
    moves = np.empty(count, position.dtype)
    for place in range(count):
        i = np.uintp(place)
        moves[i] = position[i] - found_at[i]
    least, greatest = _range_of(moves)
    return (least + greatest) / 2


@compiled
@no_type_check
def _range_of(values):
    """The least and greatest, of those that are not far away and numbers."""
    far = values.dtype.type(FAR)
    least, greatest = np.full(LANES, far), np.full(LANES, -far)
    whole = len(values) - len(values) % LANES
    # In as many lanes as vectors have, or more: one after another waits for each result.
    for start in range(0, whole, LANES):
        for lane in range(LANES):
            at, place = np.uintp(start) + np.uintp(lane), np.uintp(lane)
            value = values[at]
            is_near = (value > -far) & (value < far)
            least[place] = value if is_near & (value < least[place]) else least[place]
            greatest[place] = value if is_near & (value > greatest[place]) else greatest[place]
    low, high = least[0], greatest[0]
    for lane in range(1, LANES):
        low, high = min(low, least[lane]), max(high, greatest[lane])
    for at in values[whole:]:
        if -far < at < far:
            low, high = min(low, at), max(high, at)
    return low, high


@compiled
@no_type_check
def _find_all(
    position,
    nearest,
    distance,
    found_at,
    allowance,
    numbers,
    sizes,
    frame,
    adjacent,
    is_sheet,
):
    """Compare all with all that are near, by cells; each pair once. Returns normals, if known."""
    real = position[0].dtype.type
    count, half = len(position[0]), real(0.5)
    slack, squash, touching, reach = sizes[1], sizes[2], sizes[3], sizes[4]
    level, search = numbers[4], numbers[5]
    order, place_of, start, rows, columns = _sorted_into_cells(position, search)
    search = search * search
    clear = np.full(count, search, real)
    # Of their own: with arrays that are handed in, a lookup at 25 x 25 took 105 to 200 us, not 55.
    across, known = np.empty((count, 3), real), np.zeros(count, np.bool_)
    least, best = np.empty((2, count), real), np.empty((2, count), np.uint32)
    farthest = real(0)
    points = np.full((3, count + LANES), real(np.nan))  # After the last: near to nothing.
    marks = np.zeros(count + LANES, np.uint32)
    for place in range(count):
        i = order[place]
        best[0, i] = best[1, i] = i
        least[0, i] = least[1, i] = reach[i] * reach[i]
        farthest = max(farthest, least[0, i])
        for axis in range(3):
            points[axis, place] = position[axis][i]
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
                i, mark = order[place], np.uint32(place + 1)
                for each in range(adjacent.shape[1]):
                    marks[place_of[adjacent[i, each]]] = mark
                for part in range(2):
                    low, high = (place + 1, last) if part == 0 else (next_first, next_last)
                    for block in range(low, high, LANES):
                        near = _near(points, marks, place, block, mark, search)
                        while near:
                            lane = _lowest(near)
                            near &= near - np.uint32(1)
                            other = block + lane
                            x = points[0, other] - points[0, place]
                            y = points[1, other] - points[1, place]
                            z = points[2, other] - points[2, place]
                            squared = x * x + y * y + z * z
                            j = order[other]
                            clear[i], clear[j] = min(clear[i], squared), min(clear[j], squared)
                            if squared >= farthest:
                                continue
                            for each in (i, j):
                                if not known[each]:
                                    known[each] = True
                                    across[each] = _across(each, position, frame, is_sheet)
                            above = _height(i, x, y, z, is_sheet, across)
                            _compare(i, j, above, squared, level, squash, least, best)
                            above = -_height(j, x, y, z, is_sheet, across)
                            _compare(j, i, above, squared, level, squash, least, best)
    nearest[:], distance[:] = best, least
    above, below = least[0], least[1]
    for place in range(count):
        i = np.uintp(place)
        free = _free(min(above[i], below[i]), clear[i], touching[i], squash[i])
        allowance[i] = max(slack[i], half * free)
    for axis in range(3):
        found_at[axis] = position[axis]
    return across, known


@compiled
@no_type_check
def _find_some(
    due,
    is_due,
    position,
    nearest,
    distance,
    found_at,
    allowance,
    numbers,
    sizes,
    frame,
    adjacent,
    is_sheet,
):
    """Compare those that are due with all, and then those whose nearest has gone away.

    Marks as due what was compared. Returns whether any has another nearest, and known normals.
    """
    real, count = position[0].dtype.type, len(allowance)
    slack, squash, touching, reach = sizes[1], sizes[2], sizes[3], sizes[4]
    level, search, half = numbers[4], numbers[5] * numbers[5], real(0.5)
    points = np.full((3, count + LANES), real(np.nan))  # After the last: near to nothing.
    for axis in range(3):
        points[axis, :count] = position[axis]
    across, known = np.empty((count, 3), real), np.zeros(count, np.bool_)
    least, best = distance.copy(), np.empty((2, count), np.uint32)
    marks = np.zeros(count + LANES, np.uint32)
    ids, squares = np.empty(count, np.uint32), np.empty(count, real)
    # To the nearest that is due: squared distances, and as the search measures them.
    clear, offered, rows = np.full(count, search, real), reach * reach, due
    for k in range(2):
        for place in range(count):
            i = np.uint32(place)
            j = np.uint32(nearest[k, i])
            best[k, i] = j
            least[k, i] = real(np.inf) if is_due[j] else least[k, i]
    for turn in range(2):
        for row in range(len(rows)):
            i, mark = rows[row], np.uint32(turn * count + row + 1)
            for each in range(adjacent.shape[1]):
                marks[adjacent[i, each]] = mark
            number = 0
            for block in range(0, count, LANES):
                near = _near(points, marks, i, block, mark, search)
                while near:
                    j = block + _lowest(near)
                    near &= near - np.uint32(1)
                    x, y, z = (
                        points[0, j] - points[0, i],
                        points[1, j] - points[1, i],
                        points[2, j] - points[2, i],
                    )
                    ids[number], squares[number] = j, x * x + y * y + z * z
                    number += 1
            own_clear = search
            best[0, i] = best[1, i] = i
            least[0, i] = least[1, i] = reach[i] * reach[i]
            if number and not known[i]:
                _find_across(i, position, frame, is_sheet, across, known)
            for place in range(number):
                j, squared = ids[place], squares[place]
                own_clear = min(own_clear, squared)
                above = _height_of(j, i, points, is_sheet, across)
                _compare(i, j, above, squared, level, squash, least, best)
            if turn == 1:
                continue
            free = _free(min(least[0, i], least[1, i]), own_clear, touching[i], squash[i])
            allowance[i] = max(slack[i], half * free)
            for place in range(number):
                j, squared = ids[place], squares[place]
                if is_due[j]:
                    continue
                clear[j] = min(clear[j], squared)
                if squared < reach[j] * reach[j]:
                    if not known[j]:
                        _find_across(j, position, frame, is_sheet, across, known)
                    above = _height_of(i, j, points, is_sheet, across)
                    far = squared + squash[j] * above * above
                    if far < reach[j] * reach[j]:
                        offered[j] = min(offered[j], far)
                        _compare(j, i, above, squared, level, squash, least, best)
        if turn == 0:
            lost, num_lost = np.empty(count, np.uint32), np.uint32(0)
            for place in range(count):
                i = np.uint32(place)
                lost[num_lost] = i
                num_lost += np.uint32(
                    not is_due[i]
                    and (
                        _lost(distance[0, i], least[0, i], slack[i])
                        or _lost(distance[1, i], least[1, i], slack[i])
                    )
                )
            rows = lost[:num_lost]
    for i in range(count):
        if clear[i] < search:
            free = _free(offered[i], clear[i], touching[i], squash[i])
            x, y, z = (
                position[0][i] - found_at[0, i],
                position[1][i] - found_at[1, i],
                position[2][i] - found_at[2, i],
            )
            within = sqrt(x * x + y * y + z * z) + max(slack[i], half * free)
            allowance[i] = min(allowance[i], within)
    for i in due:
        for axis in range(3):
            found_at[axis, i] = position[axis][i]
    for i in rows:
        is_due[i] = True
    changed = False
    for k in range(2):
        for place in range(count):
            i = np.uintp(place)
            changed |= np.uint32(nearest[k, i]) != best[k, i]
            nearest[k, i], distance[k, i] = best[k, i], least[k, i]
    return changed, across, known


@njit(inline="always")
@no_type_check
def _lost(before, now, slack):
    """Whether a particle's nearest is farther than before by more than its slack."""
    if now <= before:
        return False
    limit = sqrt(before) + slack
    return now > limit * limit


@njit(inline="always")
@no_type_check
def _free(stretched, clear, touching, squash):
    """What is beside a particle may come nearer by its distance, what is above by less."""
    stretch = sqrt(np.float32(1) + squash)
    return max((sqrt(stretched) - touching) / stretch, sqrt(clear) - touching)


@compiled
@no_type_check
def _list_pairs(nearest, partner, listed_by, renewed):
    """List each particle and its nearest on a side, each pair once; mark the slots that change."""
    count, capacity = nearest.shape[1], len(listed_by)
    num_listings = np.zeros(count, np.int64)
    listed_by[:] = 2 * count
    for i in range(count):
        above, below = nearest[0, i], nearest[1, i]
        for k in range(2):
            j = nearest[k, i]
            # Not those that have been met from the other side.
            met = j < i and (nearest[0, j] == i or nearest[1, j] == i)
            if met or (k == 1 and below == above) or (j != i and num_listings[j] == capacity):
                j = i
            if j != i:
                listed_by[num_listings[j], j] = k * count + i
                num_listings[j] += 1
            renewed[k, i] = j != partner[k, i]
            partner[k, i] = j


@njit(inline="always")
@no_type_check
def _near(points, marks, place, block, mark, search):
    """Which of a block are near a particle and not marked, as bits.

    All at a time: with unsigned indices and a fixed count, and only then, LLVM makes vectors.
    """
    here, first, near = np.uintp(place), np.uintp(block), np.uint32(0)
    x, y, z = points[0, here], points[1, here], points[2, here]
    for lane in range(LANES):
        other = first + np.uintp(lane)
        dx, dy, dz = points[0, other] - x, points[1, other] - y, points[2, other] - z
        is_near = (dx * dx + dy * dy + dz * dz < search) & (marks[other] != mark)
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
    """Particles by cell along the two widest axes, their places, starts of cells, and the shape."""
    count = len(position[0])
    real = position[0].dtype.type
    lows, extents = np.empty(3, real), np.empty(3, real)
    for axis in range(3):
        least, most = _range_of(position[axis])
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
    place_of = np.empty(count, np.uint32)
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
        order[start[after]], place_of[i] = i, start[after]
    for cell in range(rows * columns):
        start[cell] = start[cell + 1]
    start[rows * columns] = count
    return order, place_of, start, rows, columns


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
def _height(i, dx, dy, dz, is_sheet, across):
    """Height over the sheet at i. Around a rope there is room: its sides are up and down."""
    if is_sheet:
        return across[i, 0] * dx + across[i, 1] * dy + across[i, 2] * dz
    return dz


@njit(inline="always")
@no_type_check
def _height_of(j, i, points, is_sheet, across):
    """Height of j over the sheet at i."""
    x, y, z = points[0, j] - points[0, i], points[1, j] - points[1, i], points[2, j] - points[2, i]
    return _height(i, x, y, z, is_sheet, across)


@compiled
@no_type_check
def _find_across(i, position, frame, is_sheet, across, known):
    """Write the unit normal of the sheet, or tangent of the rope, at a particle."""
    known[i] = True
    across[i] = _across(i, position, frame, is_sheet)


@njit(inline="always")
@no_type_check
def _compare(i, j, above, squared, level, squash, distance, nearest):
    """Whether j, that far above i, is the nearest so far on one side of i, or on both."""
    squared = squared + squash[i] * above * above
    # Selections, not branches: which way they go is anybody's guess.
    is_best = (above >= -level) & (squared < distance[0, i])
    distance[0, i] = squared if is_best else distance[0, i]
    nearest[0, i] = j if is_best else nearest[0, i]
    is_best = (above <= level) & (squared < distance[1, i])
    distance[1, i] = squared if is_best else distance[1, i]
    nearest[1, i] = j if is_best else nearest[1, i]


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
