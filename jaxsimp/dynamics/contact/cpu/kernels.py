"""Self-contact of one body as operations of XLA on the CPU, compiled by numba.

../layers.py defines both operations, `touch` and its adjoint.
"""

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
from jaxsimp.dynamics.contact.cpu.impulses import resolve, resolve_vjp
from jaxsimp.dynamics.contact.cpu.lookup import find_pairs, gone_too_far

NUM_CHANGING = 10
"""Positions, velocities, and the fields of `Contacts`."""
NUM_OPERANDS = NUM_CHANGING + 7
NUM_VJP_OPERANDS, NUM_VJP_RESULTS = 11, 5


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
    sizes, frame = matrix(sources[12], real), matrix(sources[13], np.int32)
    adjacent = matrix(sources[14], np.uint32)
    is_sheet, passes = scalar(sources[15], np.bool_)[0], scalar(sources[16], np.int32)[0]
    halo = (position.shape[1] - len(carried)) // 2
    here, speed = _rows(position, halo), _rows(velocity, halo)
    if passes > 0:
        missed[0] += resolve(
            *(here, speed, partner, direction, carried, inverse_mass, sizes[0], numbers, passes)
        )
    renewed[0] = gone_too_far(here, found_at, allowance)
    if renewed[0]:
        find_pairs(
            *(here, partner, listed_by, direction, found_at, allowance),
            *(numbers, sizes, frame, adjacent, is_sheet),
        )


@njit(inline="always")
@no_type_check
def _rows(array, halo):
    """Rows by themselves, without the halo: numba then knows that elements lie side by side."""
    end = array.shape[1] - halo
    return array[0][halo:end], array[1][halo:end], array[2][halo:end]


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
    lateral, numbers = vector(sources[6], real), vector(sources[7], real)
    given_position, given_velocity = matrix(sources[8], real), matrix(sources[9], real)
    passes = scalar(sources[10], np.int32)[0]
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
            resolve(
                (starts[turn, 0], starts[turn, 1], starts[turn, 2]),
                (starts[turn, 3], starts[turn, 4], starts[turn, 5]),
                *(partner, direction, held_up[turn], inverse_mass, lateral, numbers, 1),
            )
    for back in range(passes):
        turn = passes - 1 - back
        resolve_vjp(
            *(starts[turn], held_up[turn], partner, direction, inverse_mass, lateral, numbers),
            *(position_bar, velocity_bar, direction_bar, mass_bar, numbers_bar),
        )
