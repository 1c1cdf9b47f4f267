"""Lookup of contacts on the CPU, compiled by numba; ../lookup.py defines it.

Particles that are near each other at rest are a patch, and patches that are far from a particle are
passed over by their boxes.
"""

from math import sqrt
from typing import no_type_check  # numba needs functions as they are, not wrapped in checks

import numpy as np
from numba import njit

from jaxsimp.dynamics.contact.cpu.foreign import compiled

PATCH = 16
"""Particles of a patch, compared at a time."""
DE_BRUIJN = np.uint32(0x077CB531)
"""Any five bits of it in a row are other than any other five: shifts of it tell single bits."""
BIT_PLACES = np.empty(32, np.int64)
BIT_PLACES[[(int(DE_BRUIJN) << place & 0xFFFFFFFF) >> 27 for place in range(32)]] = range(32)
TINY = np.float32(1e-20)
"""Squared length below which a vector has no direction."""


@compiled
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
    order,
    is_sheet,
):
    """Look up the particles that moved too far, and those that they are or were nearest to."""
    renewed[:] = False
    real = position[0].dtype.type
    count, zero, half = len(allowance), real(0), real(0.5)
    if _num_beyond(position, found_at, allowance, zero, zero, zero) == 0:
        return
    due, is_due = np.empty(count, np.uint32), np.empty(count, np.bool_)
    num_due = _find_due(position, found_at, allowance, due, is_due)
    if num_due == 0:
        return
    slack, squash, touching, reach = sizes[1], sizes[2], sizes[3], sizes[4]
    level, search = numbers[4], numbers[5] * numbers[5]
    points, place_of, lows, highs = _patches(position, order)
    across, known = np.empty((count, 3), real), np.zeros(count, np.bool_)
    marks = np.zeros(points.shape[1], np.uint32)
    ids, squares = np.empty(count, np.uint32), np.empty(count, real)
    # Squared distances from each particle to the nearest that is due.
    clear, stretched = np.full(count, search, real), np.empty(count, real)
    before, far_off = np.empty((2, count), real), real(np.inf)
    for i in range(count):
        stretched[i] = reach[i]
        for k in range(2):
            before[k, i] = distance[k, i]
            distance[k, i] = far_off if is_due[nearest[k, i]] else distance[k, i]
    changed, num_again = False, 0
    again = np.empty(count, np.uint32)
    for turn in range(2):
        for each in range(num_due if turn == 0 else num_again):
            i = due[each] if turn == 0 else again[each]
            mark = np.uint32(1 + each if turn == 0 else 1 + num_due + each)
            for number in range(adjacent.shape[1]):
                marks[place_of[adjacent[i, number]]] = mark
            farthest = search if turn == 0 else reach[i]
            x, y, z = position[0][i], position[1][i], position[2][i]
            number = _list_near(
                points, lows, highs, marks, order, x, y, z, mark, farthest, ids, squares
            )
            above, below = np.uint32(i), np.uint32(i)
            least_above, least_below, own_clear = reach[i], reach[i], search
            if number:
                _find_across(i, position, frame, is_sheet, across, known)
            nx, ny, nz = across[i, 0], across[i, 1], across[i, 2]
            for place in range(number):
                j, squared = ids[place], squares[place]
                own_clear = min(own_clear, squared)
                dx, dy, dz = position[0][j] - x, position[1][j] - y, position[2][j] - z
                height = nx * dx + ny * dy + nz * dz if is_sheet else dz
                far = squared + squash[i] * height * height
                # Selections, not branches: which way they go is anybody's guess.
                is_best = (height >= -level) & (far < least_above)
                least_above = far if is_best else least_above
                above = j if is_best else above
                is_best = (height <= level) & (far < least_below)
                least_below = far if is_best else least_below
                below = j if is_best else below
            changed |= (above != nearest[0, i]) | (below != nearest[1, i])
            nearest[0, i], nearest[1, i] = above, below
            distance[0, i], distance[1, i] = least_above, least_below
            if turn == 1:
                continue
            free = _free(min(least_above, least_below), own_clear, touching[i], squash[i])
            allowance[i] = max(slack[i], half * free)
            for place in range(number):
                j, squared = ids[place], squares[place]
                if is_due[j]:
                    continue
                clear[j] = min(clear[j], squared)
                if squared < reach[j]:
                    _find_across(j, position, frame, is_sheet, across, known)
                    dx, dy, dz = x - position[0][j], y - position[1][j], z - position[2][j]
                    height = dz
                    if is_sheet:
                        height = across[j, 0] * dx + across[j, 1] * dy + across[j, 2] * dz
                    far = squared + squash[j] * height * height
                    if far < reach[j]:
                        stretched[j] = min(stretched[j], far)
                        if height >= -level and far < distance[0, j]:
                            changed |= nearest[0, j] != i
                            distance[0, j], nearest[0, j] = far, i
                        if height <= level and far < distance[1, j]:
                            changed |= nearest[1, j] != i
                            distance[1, j], nearest[1, j] = far, i
        if turn == 0:
            for i in range(count):
                if is_due[i]:
                    continue
                lost = _lost(before[0, i], distance[0, i], slack[i])
                if lost | _lost(before[1, i], distance[1, i], slack[i]):
                    again[num_again] = i
                    num_again += 1
    for i in range(count):
        if clear[i] < search and not is_due[i]:
            free = _free(stretched[i], clear[i], touching[i], squash[i])
            dx, dy, dz = (
                position[0][i] - found_at[0, i],
                position[1][i] - found_at[1, i],
                position[2][i] - found_at[2, i],
            )
            within = sqrt(dx * dx + dy * dy + dz * dz) + max(slack[i], half * free)
            allowance[i] = min(allowance[i], within)
    for each in range(num_due):
        i = due[each]
        for axis in range(3):
            found_at[axis, i] = position[axis][i]
    for each in range(num_again):
        is_due[again[each]] = True
    if changed:
        _list_pairs(nearest, partner, listed_by, renewed)
    for k in range(2):
        for i in range(count):
            j = partner[k, i]
            if j != i and (renewed[k, i] | is_due[i] | is_due[j]):
                renewed[k, i] = True
                _find_across(i, position, frame, is_sheet, across, known)
                _find_across(j, position, frame, is_sheet, across, known)
                _direct(i, j, k, position, across, is_sheet, level, direction)


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
def _list_near(points, lows, highs, marks, order, x, y, z, mark, farthest, ids, squares):
    """Write particles near a point that are not marked, and their squared distances."""
    number = 0
    for group in range(0, lows.shape[1], PATCH):
        hits = _near_boxes(lows, highs, group, x, y, z, farthest)
        while hits:
            patch = (group + _lowest(hits)) * PATCH
            hits &= hits - np.uint32(1)
            near = _near(points, marks, patch, x, y, z, mark, farthest)
            while near:
                place = patch + _lowest(near)
                near &= near - np.uint32(1)
                dx, dy, dz = points[0, place] - x, points[1, place] - y, points[2, place] - z
                ids[number], squares[number] = order[place], dx * dx + dy * dy + dz * dz
                number += 1
    return number


@njit(inline="always")
@no_type_check
def _free(stretched, clear, touching, squash):
    """What is beside a particle may come nearer by its distance, what is above by less."""
    stretch = sqrt(squash + np.float32(1))
    return max((sqrt(stretched) - touching) / stretch, sqrt(clear) - touching)


@njit(inline="always")
@no_type_check
def _find_due(position, found_at, allowance, due, is_due):
    """List and mark those that moved too far, see ../lookup.py; returns their number."""
    zero = allowance.dtype.type(0)
    x, y, z = (
        _middle_of_moves(position[0], found_at[0]),
        _middle_of_moves(position[1], found_at[1]),
        _middle_of_moves(position[2], found_at[2]),
    )
    alone = _num_beyond(position, found_at, allowance, zero, zero, zero)
    along = _num_beyond(position, found_at, allowance, x, y, z)
    if along == 0:
        return 0
    if along >= alone:
        x, y, z = zero, zero, zero
    number = np.uint32(0)
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


@njit(inline="always")
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


@njit(inline="always")
@no_type_check
def _middle_of_moves(position, found_at):
    """Half way between the least and the greatest, along an axis."""
    count, first = len(position), position[0] - found_at[0]
    least, most = np.full(PATCH, first), np.full(PATCH, first)
    for start in range(0, count - PATCH + 1, PATCH):
        for lane in range(PATCH):
            at, place = np.uintp(start) + np.uintp(lane), np.uintp(lane)
            move = position[at] - found_at[at]
            least[place] = move if move < least[place] else least[place]
            most[place] = move if move > most[place] else most[place]
    low, high = least[0], most[0]
    for lane in range(1, PATCH):
        low, high = min(low, least[lane]), max(high, most[lane])
    for i in range(count - count % PATCH, count):
        move = position[i] - found_at[i]
        low, high = min(low, move), max(high, move)
    return (low + high) / 2


@compiled
@no_type_check
def _patches(position, order):
    """Points by patch, the places of particles among them, and the least and greatest of boxes."""
    count, real = len(order), position[0].dtype.type
    patches = (count + PATCH - 1) // PATCH
    points = np.empty((3, patches * PATCH), real)
    place_of = np.empty(count, np.uint32)
    for place in range(count):
        i = order[place]
        place_of[i] = place
        points[0, place], points[1, place], points[2, place] = (
            position[0][i],
            position[1][i],
            position[2][i],
        )
    points[:, count:] = real(np.nan)  # After the last: near to nothing.
    groups = (patches + PATCH - 1) // PATCH
    lows = np.full((3, groups * PATCH), real(np.inf))
    highs = np.full((3, groups * PATCH), real(-np.inf))
    for axis in range(3):
        for patch in range(patches):
            low, high = lows[axis, patch], highs[axis, patch]
            for lane in range(PATCH):
                at = points[axis, np.uintp(patch * PATCH + lane)]
                low, high = at if at < low else low, at if at > high else high
            lows[axis, patch], highs[axis, patch] = low, high
    return points, place_of, lows, highs


@njit(inline="always")
@no_type_check
def _near_boxes(lows, highs, group, x, y, z, farthest):
    """Which boxes of a group are near a point, as bits."""
    zero, first, near = lows.dtype.type(0), np.uintp(group), np.uint32(0)
    for lane in range(PATCH):
        at = first + np.uintp(lane)
        dx = max(max(lows[0, at] - x, x - highs[0, at]), zero)
        dy = max(max(lows[1, at] - y, y - highs[1, at]), zero)
        dz = max(max(lows[2, at] - z, z - highs[2, at]), zero)
        near |= np.uint32(dx * dx + dy * dy + dz * dz < farthest) << np.uint32(lane)
    return near


@njit(inline="always")
@no_type_check
def _near(points, marks, patch, x, y, z, mark, farthest):
    """Which particles of a patch are near a point and not marked, as bits.

    All at a time: with unsigned indices and a fixed count, and only then, LLVM makes vectors.
    """
    first, near = np.uintp(patch), np.uint32(0)
    for lane in range(PATCH):
        at = first + np.uintp(lane)
        dx, dy, dz = points[0, at] - x, points[1, at] - y, points[2, at] - z
        is_near = (dx * dx + dy * dy + dz * dz < farthest) & (marks[at] != mark)
        near |= np.uint32(is_near) << np.uint32(lane)
    return near


@njit(inline="always")
@no_type_check
def _lowest(bits):
    """The place of the lowest bit that is set."""
    alone = bits & (~bits + np.uint32(1))
    return BIT_PLACES[(alone * DE_BRUIJN & np.uint32(0xFFFFFFFF)) >> np.uint32(27)]


@njit(inline="always")
@no_type_check
def _find_across(i, position, frame, is_sheet, across, known):
    """Write the unit normal of the sheet, or tangent of the rope, at a particle, if need be."""
    if not known[i]:
        known[i] = True
        across[i] = _across(i, position, frame, is_sheet)


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
