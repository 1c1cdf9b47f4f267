"""Self-contact of one body on the CPU: who may touch whom, and impulses, compiled by numba.

The nearest are found by cells: particles are sorted, along the two axes in which they are spread
widest, into cells as wide as is looked, and compared with those in the same cell and the next.
The work follows what is there; whatever is within reach is found, however much that is. What a
contact does is told, and differentiated, in layers.py; this is the same without
derivatives, and looks only at what is near.
"""

from functools import cache
from math import sqrt
from typing import no_type_check  # numba needs functions as they are, not wrapped in checks

import numpy as np
from numba import njit

from jaxsimp.dynamics.contact.cpu.foreign import (
    OK,
    compiled,
    is_call,
    matrix,
    operands,
    pass_on,
    register,
    results,
    scalar,
    vector,
)

NUM_OPERANDS, NUM_RESULTS = 14, 9
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


@cache
def touch_target(dtype: np.dtype) -> str:
    """Name of the operation for `jax.ffi.ffi_call`, in float32 or float64."""
    name = f"jaxsimp_touch_{dtype.name}"
    register(name, {"float32": _touch_float32, "float64": _touch_float64}[dtype.name])
    return name


@no_type_check
def _touch_float32(frame):
    if is_call(frame):
        _touch(operands(frame, NUM_OPERANDS), results(frame, NUM_RESULTS), np.float32)
    return OK


@no_type_check
def _touch_float64(frame):
    if is_call(frame):
        _touch(operands(frame, NUM_OPERANDS), results(frame, NUM_RESULTS), np.float64)
    return OK


@compiled
@no_type_check
def _touch(sources, targets, real):
    position, velocity = matrix(targets[0], real), matrix(targets[1], real)
    pairs, direction = matrix(targets[2], np.int32), matrix(targets[3], real)
    found_at, allowance = matrix(targets[4], real), vector(targets[5], real)
    carried, missed = vector(targets[6], real), scalar(targets[7], np.int32)
    renewed = scalar(targets[8], np.bool_)
    for place in range(8):
        is_real = place != 2 and place != 7
        pass_on(sources[place], targets[place], position.itemsize // 4 if is_real else 1)
    inverse_mass, numbers = vector(sources[8], real), vector(sources[9], real)
    frame, apart = matrix(sources[10], np.int32), matrix(sources[11], real)
    is_sheet, passes = scalar(sources[12], np.bool_)[0], scalar(sources[13], np.int32)[0]
    halo = (position.shape[1] - len(carried)) // 2
    here, speed = _rows(position, halo), _rows(velocity, halo)
    if passes > 0:
        missed[0] += _resolve(here, speed, pairs, direction, carried, inverse_mass, numbers, passes)
    renewed[0] = _gone_too_far(here, found_at, allowance)
    if renewed[0]:
        _find(here, pairs, direction, found_at, allowance, numbers, frame, apart, is_sheet)


@njit(inline="always")
@no_type_check
def _rows(array, halo):
    """Rows by themselves, without the halo: numba then knows that elements lie side by side."""
    end = array.shape[1] - halo
    return array[0][halo:end], array[1][halo:end], array[2][halo:end]


@compiled
@no_type_check
def _gone_too_far(position, found_at, allowance):
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
def _resolve(position, velocity, pairs, direction, carried, inverse_mass, numbers, passes):
    """Impulses and pushes, see `self_contact.resolve`; returns how many contacts were missed.

    Selections, not branches: what touches and what does not is anybody's guess.
    """
    real = carried.dtype.type
    thickness, reach = numbers[1], numbers[2] * numbers[2]
    friction, floor, rate, level = numbers[5], numbers[6], real(1) / numbers[7], numbers[8]
    (px, py, pz), (vx, vy, vz) = position, velocity
    along_x, along_y, along_z = direction[0], direction[1], direction[2]
    firsts, seconds = pairs[0], pairs[1]
    count, num_pairs, missed = len(carried), _length(firsts, seconds), 0
    shares, lying, total = np.empty(count, real), np.empty(count, real), np.empty((6, count), real)
    push_x, push_y, push_z, kick_x, kick_y, kick_z = total
    touching = np.empty(num_pairs + 1, np.uint32)
    own, others = np.empty(num_pairs + 1, real), np.empty(num_pairs + 1, real)
    gaps, closing = np.empty(num_pairs + 1, real), np.empty(num_pairs + 1, real)
    zero, one, half = real(0), real(1), real(0.5)
    for turn in range(passes):
        lying[:] = zero
        shares[:] = zero
        num_touching = np.uint32(0)
        for place in range(num_pairs):
            pair = np.uint32(place)
            i, j = np.uint32(firsts[pair]), np.uint32(seconds[pair])
            nx, ny, nz = along_x[pair], along_y[pair], along_z[pair]
            x, y, z = px[i] - px[j], py[i] - py[j], pz[i] - pz[j]
            distance = nx * x + ny * y + nz * z
            near = x * x + y * y + z * z - distance * distance < reach
            missed += near & (distance < zero) & (turn == 0)
            gap = distance - thickness
            lies, below, above = near & (gap < level), nz < -half, nz > half
            mine, yours = carried[i], carried[j]
            lying[i] = max(lying[i], yours if lies & above else zero)
            lying[j] = max(lying[j], mine if lies & below else zero)
            approach = nx * (vx[i] - vx[j]) + ny * (vy[i] - vy[j]) + nz * (vz[i] - vz[j])
            lacking = -max(gap, zero) * rate - approach
            touches = near & ((gap < zero) | (lacking > zero))
            mine, yours = one - mine if below else one, one - yours if above else one
            shares[i] += mine if touches else zero
            shares[j] += yours if touches else zero
            touching[num_touching] = pair
            own[num_touching], others[num_touching] = mine, yours
            gaps[num_touching], closing[num_touching] = gap, lacking
            num_touching += np.uint32(touches)
        table = floor + real(0.1) * thickness
        for i in range(count):
            carried[i] = one if pz[i] < table else lying[i]
        if num_touching == 0:
            break
        total[:] = zero
        for each in range(num_touching):
            place = np.uint32(each)
            pair = touching[place]
            i, j = np.uint32(firsts[pair]), np.uint32(seconds[pair])
            mine, yours, gap = own[place], others[place], gaps[place]
            both = mine * inverse_mass[i] * shares[i] + yours * inverse_mass[j] * shares[j]
            if not both > zero:
                continue
            per = one / both
            nx, ny, nz = along_x[pair], along_y[pair], along_z[pair]
            x, y, z = vx[i] - vx[j], vy[i] - vy[j], vz[i] - vz[j]
            approach = nx * x + ny * y + nz * z
            x, y, z = x - approach * nx, y - approach * ny, z - approach * nz
            squared = max(x * x + y * y + z * z, real(1e-12))
            impulse = max(closing[place], zero) * per
            rub = min(half * per, friction * impulse / sqrt(squared))
            x, y, z = impulse * nx - rub * x, impulse * ny - rub * y, impulse * nz - rub * z
            push = min(max(-gap, zero), thickness) * per
            mine, yours = mine * push, yours * push
            push_x[i] += mine * nx
            push_y[i] += mine * ny
            push_z[i] += mine * nz
            push_x[j] -= yours * nx
            push_y[j] -= yours * ny
            push_z[j] -= yours * nz
            kick_x[i] += x
            kick_y[i] += y
            kick_z[i] += z
            kick_x[j] -= x
            kick_y[j] -= y
            kick_z[j] -= z
        for i in range(count):
            w, height = inverse_mass[i], pz[i]
            px[i] += w * push_x[i]
            py[i] += w * push_y[i]
            pz[i] = max(height + w * push_z[i], min(height, floor))
            vx[i] += w * kick_x[i]
            vy[i] += w * kick_y[i]
            vz[i] += w * kick_z[i]
    return missed


@njit(inline="always")
@no_type_check
def _length(firsts, seconds):
    """How many pairs are listed: the rest are particles with themselves."""
    length = 0
    while length < len(firsts) and firsts[length] != seconds[length]:
        length += 1
    return length


@compiled
@no_type_check
def _find(position, pairs, direction, found_at, allowance, numbers, frame, apart, is_sheet):
    """Look up the nearest on either side of each, and the directions of their contacts."""
    real = position[0].dtype.type
    count = len(position[0])
    adjacent, thickness, slack = numbers[0] * numbers[0], numbers[1], numbers[3]
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
    _list_pairs(position, best, across, pairs, direction, thickness, level, is_sheet)


@compiled
@no_type_check
def _list_pairs(position, best, across, pairs, direction, thickness, level, is_sheet):
    """List each particle and its nearest on a side, each pair once, with its direction."""
    length = 0
    for i in range(len(best)):
        above, below = best[i, 0], best[i, 1]
        for k in range(2):
            j = best[i, k]
            # Not those that have been met from the other side.
            met = j < i and (best[j, 0] == i or best[j, 1] == i)
            if j != i and not met and not (k == 1 and below == above):
                pairs[0, length], pairs[1, length] = i, j
                _direct(i, j, length, position, across, is_sheet, thickness, level, direction)
                length += 1
    pairs[0, length:] = 0
    pairs[1, length:] = 0


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
def _direct(i, j, pair, position, across, is_sheet, thickness, level, direction):
    """The direction of a contact, see `self_contact.directions`."""
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
    direction[0, pair], direction[1, pair], direction[2, pair] = x, y, z
