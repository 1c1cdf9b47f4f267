"""Garments pressed flat: their size, their layers, and that these hold in a simulation."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxsimp import goals
from jaxsimp.bodies import cloth, from_mesh, rope, t_shirt, trousers
from jaxsimp.dynamics import at_rest, largest_time_step, make_simulation, press, settle
from jaxsimp.dynamics.contact.settings import make_self_contact

AROUND, LONG, ROWS = 32, 0.3, 16


def tube(radius=0.06):
    """A body round the y axis, open at both ends: from its least x on, front above back."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    y = np.linspace(0, LONG, ROWS)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.stack(
        [np.tile(ring[:, 0], ROWS), np.repeat(y, AROUND), np.tile(0.6 * ring[:, 1], ROWS)], axis=1
    )
    first = np.arange(AROUND * (ROWS - 1))
    after = np.where(first % AROUND == AROUND - 1, first + 1 - AROUND, first + 1)
    faces = np.concatenate(
        [
            np.stack([first, after, first + AROUND], axis=1),
            np.stack([after, after + AROUND, first + AROUND], axis=1),
        ]
    )
    return from_mesh(points, faces)


def opened(garment):
    """A garment of two sheets in space, as air blown in would open it."""
    body = garment.body
    height = 0.06 * (body.rest[:, 2] / body.rest[:, 2].max() - 0.5)
    seams = garment.opposite == np.arange(body.num_particles)
    away = np.abs(body.rest[:, None, :2] - body.rest[seams][None, :, :2]).max(axis=2).min(axis=1)
    height *= np.minimum(1.0, away / 0.05)
    return from_mesh(np.column_stack([body.rest[:, :2], height]), body.faces)


def is_above(body, front, back, positions):
    """Whether a particle of the front is above each of the back that it may touch and covers."""
    touch = np.asarray(make_self_contact(body, 1e-4).may_touch)[np.ix_(front, back)]
    reach = 0.5 * np.median(body.rest_length[body.families == 0])
    x, y = positions[front], positions[back]
    covers = np.linalg.norm(x[:, None, :2] - y[None, :, :2], axis=2) < reach
    return (x[:, None, 2] > y[None, :, 2])[touch & covers]


def test_a_tube_becomes_half_its_circumference_wide():
    body = tube()
    pressed = press(body)
    around = body.rest_length[body.families == 0]
    ring = np.linalg.norm(body.rest[1:AROUND] - body.rest[: AROUND - 1], axis=1).sum()
    ring += np.linalg.norm(body.rest[0] - body.rest[AROUND - 1])
    wide, long = np.sort(np.ptp(pressed.rest[:, :2], axis=0))
    # The two folds may lie within an edge each: 12 of 160 mm.
    np.testing.assert_allclose(wide, ring / 2, atol=2 * around.max())
    np.testing.assert_allclose(long, LONG, rtol=0.03)
    # Two layers, half of the particles each.
    heights = pressed.rest[:, 2] / body.material.thickness
    assert heights.max() <= 3
    assert abs((heights > 0).mean() - 0.5) < 0.15
    # The fabric is the same.
    for name in ("mass", "springs", "stiffness", "damping", "faces"):
        np.testing.assert_array_equal(getattr(pressed, name), getattr(body, name))
    assert largest_time_step(pressed) == largest_time_step(body)


@pytest.mark.parametrize("make", [t_shirt, trousers])
def test_a_garment_is_pressed_front_over_back_and_stays_so(make):
    garment = make(num_particles=300, sheets=2)
    body = opened(garment)
    pressed = press(body, facing=(0.0, 0.0, 1.0))
    own = garment.opposite != np.arange(body.num_particles)
    front = np.flatnonzero(own & (garment.opposite > np.arange(body.num_particles)))
    back = garment.opposite[front]
    assert is_above(pressed, front, back, pressed.rest).all()
    edges = body.families == 0
    ratio = pressed.rest_length[edges] / body.rest_length[edges]
    assert abs(np.median(ratio) - 1) < 0.02
    start = goals.flat(pressed)
    simulation = make_simulation(pressed, 2e-3, self_contact=True)
    state = settle(simulation, at_rest(jnp.asarray(start)), 250)
    assert float(state.missed) == 0
    assert is_above(pressed, front, back, np.asarray(state.position)).all()
    assert np.abs(np.asarray(state.position) - start)[:, :2].max() < 0.01


def test_what_faces_up_is_chosen():
    body = opened(t_shirt(num_particles=200, sheets=2))
    up, down = (press(body, facing=(0.0, 0.0, sign)) for sign in (1.0, -1.0))
    high = up.rest[:, 2] > 0
    assert (down.rest[high, 2] == 0).mean() > 0.9
    for wrong in ((0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)):
        with pytest.raises(ValueError, match="facing"):
            press(body, facing=wrong)


def test_a_flat_sheet_stays_as_it_is():
    body = cloth((7, 5), (0.3, 0.2))
    pressed = press(body)
    # Turned in the plane only: x and y may have changed places or signs.
    np.testing.assert_allclose(pressed.rest_length, body.rest_length, rtol=1e-3)
    np.testing.assert_array_equal(pressed.rest[:, 2], 0.0)


def test_what_cannot_be_pressed_is_refused():
    ball = trimesh.creation.icosphere(2, 0.1)
    with pytest.raises(ValueError, match=r"edges of the mesh change by .*% in the median; 10%"):
        press(from_mesh(np.array(ball.vertices), np.array(ball.faces)))
    with pytest.raises(ValueError, match="the rope has no triangles"):
        press(rope(5))
