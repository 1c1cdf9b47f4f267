"""Crumpled ropes: the same for the same seed, at rest, not overstretched, lying on each other."""

import numpy as np
import pytest

from jaxsimp import tasks
from jaxsimp.bodies import rope
from jaxsimp.dynamics import at_rest, make_simulation, settle
from jaxsimp.tasks import crumple


@pytest.fixture(scope="module")
def crumpled():
    """A short rope and what it looks like after four picks, for three seeds."""
    body = rope(11, tasks.rope.ROPE_LENGTH)
    return body, [crumple(body, seed) for seed in range(3)]


def test_a_crumpled_rope_is_the_same_for_the_same_seed_only(crumpled):
    body, shapes = crumpled
    np.testing.assert_array_equal(crumple(body, 1), shapes[1])
    again = rope(11, tasks.rope.ROPE_LENGTH)  # an equal body, compiled anew
    np.testing.assert_array_equal(crumple(again, 1), shapes[1])
    for first, second in [(0, 1), (0, 2), (1, 2)]:
        assert np.abs(shapes[first] - shapes[second]).max() > 0.05


def test_a_crumpled_rope_lies_on_the_table_at_rest(crumpled):
    body, shapes = crumpled
    simulation = make_simulation(body, 1e-3, self_contact=True)
    for position in shapes:
        assert position[:, 2].min() >= body.radius - 1e-6  # float32 rounding of a step
        later = settle(simulation, at_rest(position), 300)
        # Not a pose of a moment: left alone it stays, to a twentieth of the spacing.
        assert np.abs(later.position - position).max() < body.spacing / 20


@pytest.mark.slow
def test_parts_of_a_crumpled_rope_lie_on_each_other():
    body = rope(41, tasks.rope.ROPE_LENGTH)
    stacked = 0
    for seed in range(4):
        position = crumple(body, seed).astype(float)
        # Ten points on each segment; those nearer along the rope than it can bend are left out.
        along = np.linspace(0, 40, 401)
        points = np.stack([np.interp(along, np.arange(41), axis) for axis in position.T], axis=1)
        apart = np.linalg.norm(points[:, None] - points, axis=2)
        apart[np.abs(along[:, None] - along) < 3] = np.inf
        assert apart.min() > 0.8 * 2 * body.radius
        stacked += position[:, 2].max() > 2 * body.radius
    assert stacked > 0


def test_a_crumpled_rope_is_not_overstretched_and_not_straight(crumpled):
    body, shapes = crumpled
    # At rest on the table friction holds a tension of at most mu m g: with the 150 N/m of a
    # spring between neighbours that is 0.65 mm.
    allowed = body.material.friction * body.mass.sum() * 9.81 / 150.0
    for position in shapes:
        lengths = np.linalg.norm(np.diff(position, axis=0), axis=1)
        assert np.all(lengths <= body.spacing + allowed)
        assert np.linalg.norm(position[-1] - position[0]) < 0.97 * body.size
