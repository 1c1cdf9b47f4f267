"""One pass over all contacts on the CPU, and its adjoint; ../impulses.py defines both."""

from math import sqrt
from typing import no_type_check  # numba needs functions as they are, not wrapped in checks

import numpy as np
from numba import njit

from jaxsimp.dynamics.contact.cpu.foreign import compiled


@compiled
@no_type_check
def resolve(
    position, velocity, partner, direction, carried, inverse_mass, lateral, numbers, passes
):
    """Impulses and pushes; returns the number of contacts missed.

    Selections, not branches: what touches and what does not is anybody's guess.
    """
    real = carried.dtype.type
    thickness, friction, floor = numbers[0], numbers[1], numbers[2]
    rate, level = real(1) / numbers[3], numbers[4]
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
            reach = max(lateral[i], lateral[j])
            near = x * x + y * y + z * z - distance * distance < reach * reach
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
def _list_touching(
    start, carried, partner, direction, lateral, numbers, touching, own, others, shares
):
    """Write the pairs that touch, what they move by, and in how many each particle is.

    Returns the number of pairs.
    """
    real = carried.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    thickness, seconds = numbers[0], numbers[3]
    px, py, pz, vx, vy, vz = start
    count = len(carried)
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
            reach = max(lateral[i], lateral[j])
            near = x * x + y * y + z * z - distance * distance < reach * reach
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
    return num_touching


@compiled
@no_type_check
def _stop_at_table(
    start,
    direction,
    inverse_mass,
    numbers,
    touching,
    own,
    others,
    shares,
    position_bar,
    pushed_bar,
    numbers_bar,
):
    """End the cotangents of pushes, and of heights, where the table holds against a push."""
    real = shares.dtype.type
    zero, thickness, floor = real(0), numbers[0], numbers[2]
    px, py, pz = start[0], start[1], start[2]
    raised = np.zeros(len(shares), real)
    for place in range(len(touching)):
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
    for i in range(len(shares)):
        height = pz[i] + inverse_mass[i] * raised[i]
        if height < min(pz[i], floor):
            pushed_bar[2, i] = zero
            if pz[i] >= floor:
                numbers_bar[2] += position_bar[2, i]
                position_bar[2, i] = zero


@compiled
@no_type_check
def resolve_vjp(
    start,
    carried,
    partner,
    direction,
    inverse_mass,
    lateral,
    numbers,
    position_bar,
    velocity_bar,
    direction_bar,
    mass_bar,
    numbers_bar,
):
    """Adjoint of one pass of `resolve`: cotangents of its result become those of its start."""
    real = carried.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    thickness, friction, seconds = numbers[0], numbers[1], numbers[3]
    px, py, pz, vx, vy, vz = start
    count = len(carried)
    touching = np.empty((2 * count, 3), np.uint32)
    own, others = np.empty(2 * count, real), np.empty(2 * count, real)
    shares = np.zeros(count, real)
    num_touching = _list_touching(
        start, carried, partner, direction, lateral, numbers, touching, own, others, shares
    )
    if num_touching == 0:
        return
    pushed_bar, kicked_bar = position_bar.copy(), velocity_bar.copy()
    _stop_at_table(
        *(start, direction, inverse_mass, numbers, touching[:num_touching], own, others, shares),
        *(position_bar, pushed_bar, numbers_bar),
    )
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
