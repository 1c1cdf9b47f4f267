"""Self-contact of one body on the CPU: who may touch whom, and impulses, compiled by numba.

The nearest are found by cells: particles are sorted, along the two axes in which they are spread
widest, into cells as wide as is looked, and compared with those in the same cell and the next.
The work follows what is there; whatever is within reach is found, however much that is. What a
contact does is told, and differentiated, in layers.py; this is the same without
derivatives, and looks only at what is near.
"""

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
    tensor,
    vector,
)

NUM_CHANGING = 10
"""Positions, velocities, and the fields of `Contacts`."""
NUM_OPERANDS = NUM_CHANGING + 6
NUM_VJP_OPERANDS, NUM_VJP_RESULTS = 10, 5
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


def register_kernel(name: str, dtype: str) -> None:
    """Make a kernel, `touch` or `touch_vjp`, known to XLA as an operation of float32 or float64.

    Raises:
        jax.errors.JaxRuntimeError: if XLA does not support its interface.
    """
    register(f"jaxsimp_{name}_{dtype}", globals()[f"_{name}_{dtype}"])


@no_type_check
def _touch_float32(frame):
    if is_call(frame):
        _touch(operands(frame, NUM_OPERANDS), results(frame, NUM_CHANGING), np.float32)
    return OK


@no_type_check
def _touch_float64(frame):
    if is_call(frame):
        _touch(operands(frame, NUM_OPERANDS), results(frame, NUM_CHANGING), np.float64)
    return OK


@compiled
@no_type_check
def _touch(sources, targets, real):
    position, velocity = matrix(targets[0], real), matrix(targets[1], real)
    partner, listed_by = matrix(targets[2], np.int32), matrix(targets[3], np.int32)
    direction = tensor(targets[4], real)
    found_at, allowance = matrix(targets[5], real), vector(targets[6], real)
    carried, missed = vector(targets[7], real), scalar(targets[8], real)
    renewed = scalar(targets[9], np.bool_)
    words = position.itemsize // 4
    for place in range(9):
        pass_on(sources[place], targets[place], 1 if place == 2 or place == 3 else words)
    inverse_mass, numbers = vector(sources[10], real), vector(sources[11], real)
    frame, apart = matrix(sources[12], np.int32), matrix(sources[13], real)
    is_sheet, passes = scalar(sources[14], np.bool_)[0], scalar(sources[15], np.int32)[0]
    halo = (position.shape[1] - len(carried)) // 2
    here, speed = _rows(position, halo), _rows(velocity, halo)
    if passes > 0:
        missed[0] += _resolve(
            here, speed, partner, direction, carried, inverse_mass, numbers, passes
        )
    renewed[0] = _gone_too_far(here, found_at, allowance)
    if renewed[0]:
        _find(
            *(here, partner, listed_by, direction, found_at, allowance),
            *(numbers, frame, apart, is_sheet),
        )


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
def _resolve(position, velocity, partner, direction, carried, inverse_mass, numbers, passes):
    """Impulses and pushes, see impulses.py; returns the number of contacts missed.

    Selections, not branches: what touches and what does not is anybody's guess.
    """
    real = carried.dtype.type
    thickness, reach = numbers[1], numbers[2] * numbers[2]
    friction, floor, rate, level = numbers[5], numbers[6], real(1) / numbers[7], numbers[8]
    (px, py, pz), (vx, vy, vz) = position, velocity
    count, missed = len(carried), 0
    along, partners = direction.reshape(3, 2 * count), partner.reshape(2 * count)
    along_x, along_y, along_z = along[0], along[1], along[2]
    slots = np.empty(2 * count + 1, np.uint32)
    num_pairs = _list_slots(partner, slots)
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
            pair = slots[np.uint32(place)]
            i, j = _particle(pair, count), np.uint32(partners[pair])
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
            i, j = _particle(pair, count), np.uint32(partners[pair])
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
def _particle(slot, count):
    """The particle whose slot it is."""
    return slot - np.uint32(count) if slot >= np.uint32(count) else slot


@njit(inline="always")
@no_type_check
def _list_slots(partner, slots):
    """Write the slots that hold a pair; returns their number."""
    length, count = np.uint32(0), np.uint32(partner.shape[1])
    above, below = partner[0], partner[1]
    # Written in any case, and kept if it is a pair: no branch to guess.
    for place in range(count):
        i = np.uint32(place)
        slots[length] = i
        length += np.uint32(above[i] != i)
    for place in range(count):
        i = np.uint32(place)
        slots[length] = count + i
        length += np.uint32(below[i] != i)
    return length


@compiled
@no_type_check
def _find(
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


@no_type_check
def _touch_vjp_float32(frame):
    if is_call(frame):
        _touch_vjp(operands(frame, NUM_VJP_OPERANDS), results(frame, NUM_VJP_RESULTS), np.float32)
    return OK


@no_type_check
def _touch_vjp_float64(frame):
    if is_call(frame):
        _touch_vjp(operands(frame, NUM_VJP_OPERANDS), results(frame, NUM_VJP_RESULTS), np.float64)
    return OK


@compiled
@no_type_check
def _touch_vjp(sources, targets, real):
    """Cotangents of what goes into the passes over all contacts, for those of what comes out."""
    position, velocity = matrix(sources[0], real), matrix(sources[1], real)
    partner, direction = matrix(sources[2], np.int32), tensor(sources[3], real)
    carried, inverse_mass = vector(sources[4], real), vector(sources[5], real)
    numbers = vector(sources[6], real)
    given_position, given_velocity = matrix(sources[7], real), matrix(sources[8], real)
    passes = scalar(sources[9], np.int32)[0]
    position_bar, velocity_bar = matrix(targets[0], real), matrix(targets[1], real)
    direction_bar, mass_bar = tensor(targets[2], real), vector(targets[3], real)
    numbers_bar = vector(targets[4], real)
    position_bar[:], velocity_bar[:] = given_position, given_velocity
    direction_bar[:] = 0
    mass_bar[:] = 0
    numbers_bar[:] = 0
    count = len(carried)
    halo = (position.shape[1] - count) // 2
    starts, held_up = np.empty((passes, 6, count), real), np.empty((passes, count), real)
    for turn in range(passes):
        if turn == 0:
            for axis in range(3):
                starts[0, axis] = position[axis, halo : halo + count]
                starts[0, 3 + axis] = velocity[axis, halo : halo + count]
            held_up[0] = carried
        else:
            starts[turn] = starts[turn - 1]
            held_up[turn] = held_up[turn - 1]
            _resolve(
                (starts[turn, 0], starts[turn, 1], starts[turn, 2]),
                (starts[turn, 3], starts[turn, 4], starts[turn, 5]),
                *(partner, direction, held_up[turn], inverse_mass, numbers, 1),
            )
    for back in range(passes):
        turn = passes - 1 - back
        _pass_vjp(
            *(starts[turn], held_up[turn], partner, direction, inverse_mass, numbers),
            *(position_bar, velocity_bar, direction_bar, mass_bar, numbers_bar),
        )


@compiled
@no_type_check
def _pass_vjp(
    start,
    carried,
    partner,
    direction,
    inverse_mass,
    numbers,
    position_bar,
    velocity_bar,
    direction_bar,
    mass_bar,
    numbers_bar,
):
    """Adjoint of one pass of `_resolve`: cotangents of its result become those of its start."""
    real = carried.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    thickness, reach = numbers[1], numbers[2] * numbers[2]
    friction, floor, seconds = numbers[5], numbers[6], numbers[7]
    px, py, pz, vx, vy, vz = start
    count = len(carried)
    touching = np.empty((2 * count, 3), np.uint32)
    own, others, shares = (
        np.empty(2 * count, real),
        np.empty(2 * count, real),
        np.zeros(count, real),
    )
    num_touching = 0
    for side in range(2):
        for i in range(count):
            j = partner[side, i]
            if j == i:
                continue
            nx, ny, nz = direction[0, side, i], direction[1, side, i], direction[2, side, i]
            x, y, z = px[i] - px[j], py[i] - py[j], pz[i] - pz[j]
            distance = nx * x + ny * y + nz * z
            gap = distance - thickness
            approach = nx * (vx[i] - vx[j]) + ny * (vy[i] - vy[j]) + nz * (vz[i] - vz[j])
            lacking = -max(gap, zero) / seconds - approach
            near = x * x + y * y + z * z - distance * distance < reach
            if not (near and (gap < zero or lacking > zero)):
                continue
            mine = one - carried[i] if nz < -half else one
            yours = one - carried[j] if nz > half else one
            shares[i] += mine
            shares[j] += yours
            own[num_touching], others[num_touching] = mine, yours
            touching[num_touching, 0], touching[num_touching, 1] = i, j
            touching[num_touching, 2] = side
            num_touching += 1
    if num_touching == 0:
        return
    # Where the table stops a push, its cotangent ends.
    raised = np.zeros(count, real)
    for place in range(num_touching):
        i, j, side = touching[place]
        mine, yours = own[place], others[place]
        both = mine * inverse_mass[i] * shares[i] + yours * inverse_mass[j] * shares[j]
        if both > zero:
            nx, ny, nz = direction[0, side, i], direction[1, side, i], direction[2, side, i]
            x, y, z = px[i] - px[j], py[i] - py[j], pz[i] - pz[j]
            gap = nx * x + ny * y + nz * z - thickness
            push = min(max(-gap, zero), thickness) / both * nz
            raised[i] += mine * push
            raised[j] -= yours * push
    pushed_bar, kicked_bar = position_bar.copy(), velocity_bar.copy()
    for i in range(count):
        height = pz[i] + inverse_mass[i] * raised[i]
        if height < min(pz[i], floor):
            pushed_bar[2, i] = zero
            if pz[i] >= floor:
                numbers_bar[2] += position_bar[2, i]
                position_bar[2, i] = zero
    for place in range(num_touching):
        i, j, side = touching[place]
        mine, yours = own[place], others[place]
        first, second = inverse_mass[i], inverse_mass[j]
        both = mine * first * shares[i] + yours * second * shares[j]
        if not both > zero:
            continue
        per = one / both
        nx, ny, nz = direction[0, side, i], direction[1, side, i], direction[2, side, i]
        x, y, z = px[i] - px[j], py[i] - py[j], pz[i] - pz[j]
        u, v, w = vx[i] - vx[j], vy[i] - vy[j], vz[i] - vz[j]
        approach = nx * u + ny * v + nz * w
        sx, sy, sz = u - approach * nx, v - approach * ny, w - approach * nz
        gap = nx * x + ny * y + nz * z - thickness
        lacking = -max(gap, zero) / seconds - approach
        pressed = min(max(-gap, zero), thickness)
        impulse, push = per * max(lacking, zero), per * pressed
        square = sx * sx + sy * sy + sz * sz
        inverse = one / sqrt(max(square, real(1e-12)))
        sticks = half * per <= friction * impulse * inverse
        rub = half * per if sticks else friction * impulse * inverse
        # Cotangents of the push on both, and of the change of both velocities.
        a, b = first * mine, second * yours
        fx = a * pushed_bar[0, i] - b * pushed_bar[0, j]
        fy = a * pushed_bar[1, i] - b * pushed_bar[1, j]
        fz = a * pushed_bar[2, i] - b * pushed_bar[2, j]
        gx = first * kicked_bar[0, i] - second * kicked_bar[0, j]
        gy = first * kicked_bar[1, i] - second * kicked_bar[1, j]
        gz = first * kicked_bar[2, i] - second * kicked_bar[2, j]
        push_bar = fx * nx + fy * ny + fz * nz
        impulse_bar = gx * nx + gy * ny + gz * nz
        rub_bar = -(gx * sx + gy * sy + gz * sz)
        slide = -rub
        per_bar = zero
        if sticks:
            per_bar += half * rub_bar
        else:
            numbers_bar[1] += impulse * inverse * rub_bar
            impulse_bar += friction * inverse * rub_bar
        ax, ay, az = slide * gx, slide * gy, slide * gz
        if not sticks and square > real(1e-12):
            slope = -friction * impulse * inverse * inverse * inverse * rub_bar
            ax, ay, az = ax + slope * sx, ay + slope * sy, az + slope * sz
        approach_bar = -(ax * nx + ay * ny + az * nz)
        ox = push * fx + impulse * gx - approach * ax
        oy = push * fy + impulse * gy - approach * ay
        oz = push * fz + impulse * gz - approach * az
        gap_bar = zero
        if lacking > zero:
            per_bar += lacking * impulse_bar
            lacking_bar = per * impulse_bar
            approach_bar -= lacking_bar
            if gap > zero:
                gap_bar -= lacking_bar / seconds
                numbers_bar[3] += lacking_bar * gap / (seconds * seconds)
        per_bar += pressed * push_bar
        if pressed == thickness:
            numbers_bar[0] += per * push_bar
        elif pressed > zero:
            gap_bar -= per * push_bar
        numbers_bar[0] -= gap_bar
        ox += gap_bar * x + approach_bar * u
        oy += gap_bar * y + approach_bar * v
        oz += gap_bar * z + approach_bar * w
        direction_bar[0, side, i] += ox
        direction_bar[1, side, i] += oy
        direction_bar[2, side, i] += oz
        ax, ay, az = ax + approach_bar * nx, ay + approach_bar * ny, az + approach_bar * nz
        velocity_bar[0, i] += ax
        velocity_bar[1, i] += ay
        velocity_bar[2, i] += az
        velocity_bar[0, j] -= ax
        velocity_bar[1, j] -= ay
        velocity_bar[2, j] -= az
        x, y, z = gap_bar * nx, gap_bar * ny, gap_bar * nz
        position_bar[0, i] += x
        position_bar[1, i] += y
        position_bar[2, i] += z
        position_bar[0, j] -= x
        position_bar[1, j] -= y
        position_bar[2, j] -= z
        both_bar = -per * per * per_bar
        cx, cy, cz = impulse * nx - rub * sx, impulse * ny - rub * sy, impulse * nz - rub * sz
        mass_bar[i] += mine * shares[i] * both_bar + mine * push * (
            nx * pushed_bar[0, i] + ny * pushed_bar[1, i] + nz * pushed_bar[2, i]
        )
        mass_bar[i] += cx * kicked_bar[0, i] + cy * kicked_bar[1, i] + cz * kicked_bar[2, i]
        mass_bar[j] += yours * shares[j] * both_bar - yours * push * (
            nx * pushed_bar[0, j] + ny * pushed_bar[1, j] + nz * pushed_bar[2, j]
        )
        mass_bar[j] -= cx * kicked_bar[0, j] + cy * kicked_bar[1, j] + cz * kicked_bar[2, j]
