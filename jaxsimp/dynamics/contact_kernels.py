"""Self-contact of one body on the CPU: who may touch whom, and impulses, compiled by numba.

The nearest are found by cells: particles are sorted into cubes as wide as is looked, and compared
with those in the same cube and the next ones. The work follows what is there; whatever is within
reach is found, however much that is. What a contact does is told, and differentiated, in
self_contact.py; this is the same without derivatives, and looks only at what is near.
"""

from functools import cache
from math import sqrt
from typing import no_type_check  # numba needs the functions as they are, not wrapped in checks

import numpy as np
from numba import njit

from jaxsimp.dynamics.foreign import cube, matrix, register, scalar, vector

NUM_OPERANDS, NUM_RESULTS = 14, 9
FAR = 1e4
"""What is farther away than this, metres, has no say in where cells are."""


@cache
def touch_target(dtype: np.dtype) -> str:
    """Name of the operation for `jax.ffi.ffi_call`, in float32 or float64."""
    name = f"jaxsimp_touch_{dtype.name}"
    register(name, _kernel_of(dtype.type), NUM_OPERANDS, NUM_RESULTS)
    return name


@no_type_check
def _kernel_of(real):
    @njit
    def kernel(operands, results):
        position, velocity = matrix(results[0], real), matrix(results[1], real)
        partner, direction = matrix(results[2], np.int32), cube(results[3], real)
        found_at, allowance = matrix(results[4], real), vector(results[5], real)
        carried, missed = vector(results[6], real), scalar(results[7], np.int32)
        renewed = scalar(results[8], np.bool_)
        # XLA hands out the operands' own memory where it can.
        position[:], velocity[:] = matrix(operands[0], real), matrix(operands[1], real)
        partner[:], direction[:] = matrix(operands[2], np.int32), cube(operands[3], real)
        found_at[:], allowance[:] = matrix(operands[4], real), vector(operands[5], real)
        carried[:], missed[:] = vector(operands[6], real), scalar(operands[7], np.int32)
        inverse_mass, numbers = vector(operands[8], real), vector(operands[9], real)
        frame, apart = matrix(operands[10], np.int32), matrix(operands[11], real)
        is_sheet, passes = scalar(operands[12], np.bool_)[0], scalar(operands[13], np.int32)[0]
        halo = (position.shape[1] - len(carried)) // 2
        here = position[:, halo : halo + len(carried)]
        speed = velocity[:, halo : halo + len(carried)]
        if passes > 0:
            missed[0] += _resolve(
                here, speed, partner, direction, carried, inverse_mass, numbers, passes
            )
        renewed[0] = _gone_too_far(here, found_at, allowance)
        if renewed[0]:
            _find(here, partner, direction, found_at, allowance, numbers, frame, apart, is_sheet)

    return kernel


@njit
@no_type_check
def _gone_too_far(position, found_at, allowance):
    far = False
    for i in range(len(allowance)):
        x, y, z = (
            position[0, i] - found_at[0, i],
            position[1, i] - found_at[1, i],
            position[2, i] - found_at[2, i],
        )
        far |= not x * x + y * y + z * z <= allowance[i] * abs(allowance[i])
    return far


@njit
@no_type_check
def _resolve(position, velocity, partner, direction, carried, inverse_mass, numbers, passes):
    """Impulses and pushes, see `self_contact.resolve`; returns how many contacts were missed."""
    real = position.dtype.type
    thickness, reach = numbers[1], numbers[2] * numbers[2]
    friction, floor, seconds, level = numbers[5], numbers[6], numbers[7], numbers[8]
    count, missed = position.shape[1], 0
    shares, lying = np.empty(count, real), np.empty(count, real)
    total = np.empty((count, 6), real)
    first, second = np.empty(2 * count, np.int32), np.empty(2 * count, np.int32)
    side = np.empty(2 * count, np.int32)
    own, others = np.empty(2 * count, real), np.empty(2 * count, real)
    gaps, closing = np.empty(2 * count, real), np.empty(2 * count, real)
    zero, one, half = real(0), real(1), real(0.5)
    for turn in range(passes):
        shares[:] = zero
        lying[:] = zero
        touching = 0
        for k in range(2):
            for i in range(count):
                j = partner[k, i]
                if j == i:
                    continue
                nx, ny, nz = direction[0, k, i], direction[1, k, i], direction[2, k, i]
                x = position[0, i] - position[0, j]
                y = position[1, i] - position[1, j]
                z = position[2, i] - position[2, j]
                distance = nx * x + ny * y + nz * z
                if x * x + y * y + z * z - distance * distance >= reach:
                    continue
                if turn == 0 and distance < zero:
                    missed += 1
                gap = distance - thickness
                below, above = nz < -half, nz > half
                if gap < level:
                    if above:
                        lying[i] = max(lying[i], carried[j])
                    elif below:
                        lying[j] = max(lying[j], carried[i])
                approach = (
                    nx * (velocity[0, i] - velocity[0, j])
                    + ny * (velocity[1, i] - velocity[1, j])
                    + nz * (velocity[2, i] - velocity[2, j])
                )
                lacking = -max(gap, zero) / seconds - approach
                if gap >= zero and lacking <= zero:
                    continue
                mine = one - carried[i] if below else one
                yours = one - carried[j] if above else one
                shares[i] += mine
                shares[j] += yours
                first[touching], second[touching], side[touching] = i, j, k
                own[touching], others[touching], gaps[touching] = mine, yours, gap
                closing[touching] = lacking
                touching += 1
        total[:] = zero
        for each in range(touching):
            i, j, k = first[each], second[each], side[each]
            mine, yours, gap, lacking = own[each], others[each], gaps[each], closing[each]
            both = mine * inverse_mass[i] * shares[i] + yours * inverse_mass[j] * shares[j]
            if not both > zero:
                continue
            nx, ny, nz = direction[0, k, i], direction[1, k, i], direction[2, k, i]
            x = velocity[0, i] - velocity[0, j]
            y = velocity[1, i] - velocity[1, j]
            z = velocity[2, i] - velocity[2, j]
            approach = nx * x + ny * y + nz * z
            x, y, z = x - approach * nx, y - approach * ny, z - approach * nz
            squared = max(x * x + y * y + z * z, real(1e-12))
            impulse = max(lacking, zero) / both
            rub = min(half / both, friction * impulse / sqrt(squared))
            push = min(max(-gap, zero), thickness) / both
            x, y, z = impulse * nx - rub * x, impulse * ny - rub * y, impulse * nz - rub * z
            total[i, 0] += mine * push * nx
            total[i, 1] += mine * push * ny
            total[i, 2] += mine * push * nz
            total[i, 3] += x
            total[i, 4] += y
            total[i, 5] += z
            total[j, 0] -= yours * push * nx
            total[j, 1] -= yours * push * ny
            total[j, 2] -= yours * push * nz
            total[j, 3] -= x
            total[j, 4] -= y
            total[j, 5] -= z
        for i in range(count):
            lies = position[2, i] < floor + real(0.1) * thickness
            carried[i] = one if lies else lying[i]
            w = inverse_mass[i]
            position[0, i] += w * total[i, 0]
            position[1, i] += w * total[i, 1]
            height = position[2, i]
            position[2, i] = max(height + w * total[i, 2], min(height, floor))
            velocity[0, i] += w * total[i, 3]
            velocity[1, i] += w * total[i, 4]
            velocity[2, i] += w * total[i, 5]
    return missed


@njit
@no_type_check
def _find(position, partner, direction, found_at, allowance, numbers, frame, apart, is_sheet):
    """Look up the nearest on either side of each, and the directions of their contacts."""
    real = position.dtype.type
    count = position.shape[1]
    adjacent, thickness, slack = numbers[0] * numbers[0], numbers[1], numbers[3]
    squash, level, touching, reach = numbers[4], numbers[8], numbers[9], numbers[10]
    order, start, shape = _sorted_into_cells(position, reach)
    normal = np.empty((count, 3), real)
    known = np.zeros(count, np.bool_)
    nearest = np.full((2, count), reach * reach, real)
    for k in range(2):
        for i in range(count):
            partner[k, i] = i
    # Cells in the same order of coordinates as `_sorted_into_cells`; each pair is met once: in
    # the cell itself, its follower along the last axis, or one of four rows of three cells.
    x = np.empty((3, count), real)
    rest = np.empty((3, count), real)
    for place in range(count):
        for axis in range(3):
            x[axis, place] = position[axis, order[place]]
            rest[axis, place] = apart[axis, order[place]]
    for a in range(shape[0]):
        for b in range(shape[1]):
            for c in range(shape[2]):
                cell = (a * shape[1] + b) * shape[2] + c
                low, high = start[cell], start[cell + 1]
                if low == high:
                    continue
                for row in range(5):
                    u = a + (1 if row > 1 else 0)
                    v = b + (row - 3 if row > 1 else row)
                    if u >= shape[0] or v < 0 or v >= shape[1]:
                        continue
                    line = (u * shape[1] + v) * shape[2]
                    from_ = start[line + max(c - 1, 0)]
                    to = start[line + min(c + 2, shape[2])]
                    for place in range(low, high):
                        begin = place + 1 if row == 0 else from_
                        for other in range(begin, to):
                            dx = x[0, other] - x[0, place]
                            dy = x[1, other] - x[1, place]
                            dz = x[2, other] - x[2, place]
                            squared = dx * dx + dy * dy + dz * dz
                            if squared >= reach * reach:
                                continue
                            rx = rest[0, other] - rest[0, place]
                            ry = rest[1, other] - rest[1, place]
                            rz = rest[2, other] - rest[2, place]
                            if rx * rx + ry * ry + rz * rz < adjacent:
                                continue
                            i, j = order[place], order[other]
                            _compare(
                                i, j, dx, dy, dz, squared, position, frame, is_sheet, squash,
                                level, normal, known, nearest, partner,
                            )
                            _compare(
                                j, i, -dx, -dy, -dz, squared, position, frame, is_sheet, squash,
                                level, normal, known, nearest, partner,
                            )
    stretch = sqrt(real(1) + squash)
    for i in range(count):
        closest = sqrt(min(nearest[0, i], nearest[1, i]))
        allowance[i] = max(slack, (closest - touching) / (real(2) * stretch))
        for axis in range(3):
            found_at[axis, i] = position[axis, i]
        for k in range(2):
            _direct(i, partner[k, i], k, position, frame, is_sheet, thickness, level, direction)


@njit
@no_type_check
def _sorted_into_cells(position, width):
    """Particles by cell, where each cell's begin, and how many cells there are along each axis."""
    count = position.shape[1]
    low, cells = np.empty(3, position.dtype), np.empty(3, np.int64)
    # No more cells than a few for each particle: what has flown apart gets wider ones.
    while True:
        number = 1.0
        for axis in range(3):
            least, most = position.dtype.type(FAR), position.dtype.type(-FAR)
            for i in range(count):
                along = position[axis, i]
                if -FAR < along < FAR:
                    least, most = min(least, along), max(most, along)
            low[axis] = least
            cells[axis] = 1 + (int((most - least) / width) if most > least else 0)
            number *= cells[axis]
        if number <= 8 * count + 64:
            break
        width *= 2
    start = np.zeros(cells[0] * cells[1] * cells[2] + 1, np.int32)
    cell_of, order = np.empty(count, np.int32), np.empty(count, np.int32)
    scale = 1 / width
    for i in range(count):
        cell = 0
        for axis in range(3):
            share = (position[axis, i] - low[axis]) * scale
            # Whatever is not a number goes into the first.
            inside = int(share) if 0 <= share < cells[axis] else 0
            outermost = cells[axis] - 1 if share >= cells[axis] else inside
            cell = cell * cells[axis] + outermost
        cell_of[i] = cell
        start[cell + 1] += 1
    for cell in range(len(start) - 1):
        start[cell + 1] += start[cell]
    for i in range(count - 1, -1, -1):
        cell = cell_of[i] + 1
        start[cell] -= 1
        order[start[cell]] = i
    # Each begin was moved one cell down by that.
    for cell in range(len(start) - 1):
        start[cell] = start[cell + 1]
    start[len(start) - 1] = count
    return order, start, cells


@njit(inline="always")
@no_type_check
def _across(i, position, frame, is_sheet):
    """Unit normal of the sheet, or tangent of the rope, at a particle."""
    real = position.dtype.type
    a, b, c, d = frame[0, i], frame[1, i], frame[2, i], frame[3, i]
    x = position[0, a] - position[0, b]
    y = position[1, a] - position[1, b]
    z = position[2, a] - position[2, b]
    if is_sheet:
        u = position[0, c] - position[0, d]
        v = position[1, c] - position[1, d]
        w = position[2, c] - position[2, d]
        x, y, z = y * w - z * v, z * u - x * w, x * v - y * u
    return _unit(x, y, z, real(0), real(0), real(1))


@njit(inline="always")
@no_type_check
def _unit(x, y, z, otherwise_x, otherwise_y, otherwise_z):
    squared = x * x + y * y + z * z
    if squared > 1e-20:
        scale = 1 / sqrt(squared)
        return x * scale, y * scale, z * scale
    return otherwise_x, otherwise_y, otherwise_z


@njit(inline="always")
@no_type_check
def _compare(
    i, j, dx, dy, dz, squared, position, frame, is_sheet, squash, level, normal, known, nearest,
    partner,
):
    """Whether j, at (dx, dy, dz) of i, is the nearest so far on one side of i, or on both."""
    if not known[i]:
        known[i] = True
        normal[i] = (0, 0, 1)
        if is_sheet:
            normal[i] = _across(i, position, frame, is_sheet)
    above = normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz
    squared = squared + squash * above * above
    if above >= -level and squared < nearest[0, i]:
        nearest[0, i] = squared
        partner[0, i] = j
    if above <= level and squared < nearest[1, i]:
        nearest[1, i] = squared
        partner[1, i] = j


@njit(inline="always")
@no_type_check
def _direct(i, j, k, position, frame, is_sheet, thickness, level, direction):
    """The direction of a contact, see `self_contact.directions`."""
    real = position.dtype.type
    zero, one = real(0), real(1)
    x, y, z = zero, zero, one
    if i != j:
        dx = position[0, i] - position[0, j]
        dy = position[1, i] - position[1, j]
        dz = position[2, i] - position[2, j]
        sx, sy, sz = _unit(dx, dy, dz, zero, zero, one)
        x, y, z = sx, sy, sz
        mx, my, mz = _across(i, position, frame, is_sheet)
        yx, yy, yz = _across(j, position, frame, is_sheet)
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
