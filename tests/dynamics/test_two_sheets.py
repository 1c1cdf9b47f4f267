"""A T-shirt of two sheets: dropped, folded and differentiated; front and back stay apart."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.physics.two_sheets import (
    fold_line,
    folded,
    from_seam,
    gaps_of_layers,
    heights,
    in_the_air,
    is_front,
    on_seam,
    settled,
    shirt,
    simulation_of,
)
from jaxsimp.bodies import Garment
from jaxsimp.dynamics import Actions, at_rest, make_pickers, make_simulation, rollout
from jaxsimp.dynamics.contact.settings import make_self_contact

CREASE, SEAM = 0.03, 0.02
"""Distances from the fold's line and from seams within which triangles may cross, metres."""


@cache
def may_touch(garment: Garment) -> np.ndarray:
    """Pairs of particles that are not adjacent along the body, shape (N, N)."""
    return make_self_contact(garment.body, 1e-4).may_touch


def closest(garment: Garment, position: np.ndarray) -> float:
    """Distance of the closest pair that may touch, in thicknesses; 2 if none is closer."""
    reach = 2 * garment.body.material.thickness
    pairs = cKDTree(position).query_pairs(reach, output_type="ndarray")
    first, second = pairs[may_touch(garment)[tuple(pairs.T)]].T
    near = np.linalg.norm(position[first] - position[second], axis=1)
    return 2 * near.min(initial=reach) / reach


def inside_out(garment: Garment, position: np.ndarray) -> float:
    """Of the pairs of front and back that may touch, the fraction whose front is behind the back.

    Behind is where the triangles of the back face.
    """
    faces = garment.body.faces
    a, b, c = position[faces].transpose(1, 0, 2)
    normal = np.zeros_like(position)
    np.add.at(normal, faces, np.cross(b - a, c - a)[:, None])
    back = np.flatnonzero(~is_front(garment))
    back = back[may_touch(garment)[back, garment.opposite[back]]]
    away = position[garment.opposite[back]] - position[back]
    return float(((normal[back] * away).sum(axis=1) > 0).mean())


def test_the_neighbourhood_of_a_seam_is_one_row_of_particles_wide():
    """Front and back next to the seam are neighbours round it; farther off they may touch."""
    for num_particles in (800, 3600):
        garment = shirt(num_particles)
        body, flat = garment.body, garment.body.rest[:, :2]
        away = from_seam(garment, flat, flat)[~on_seam(garment)]
        touches = may_touch(garment)[np.arange(len(flat)), garment.opposite][~on_seam(garment)]
        edge = np.median(body.rest_length[body.families == 0])
        assert not touches[away < 1.1 * edge].any()
        assert touches[away > 1.6 * edge].all()


def drops(garment: Garment, seeds: range, **options: bool) -> tuple[np.ndarray, np.ndarray]:
    """Closest pair, and fraction inside out, of T-shirts that were dropped 2 s ago."""
    simulation = simulation_of(garment, **options)
    found = []
    for seed in seeds:
        start = in_the_air(garment, seed)
        assert 0.05 < start[:, 2].min() < 0.11
        assert closest(garment, start) > 0.98
        assert inside_out(garment, start) == 0
        position = settled(simulation, start, 2.0)
        assert position[:, 2].min() < 1.01 * garment.body.radius  # on the table
        found.append((closest(garment, position), inside_out(garment, position)))
    near, wrong = np.transpose(found)
    return near, wrong


def test_front_and_back_of_a_dropped_t_shirt_hold_each_other_apart():
    garment = shirt(800)
    near, wrong = drops(garment, range(4))
    assert (near >= 0.8).sum() >= 3
    assert wrong.mean() < 0.05
    # Without contact they lie in one plane.
    near, _ = drops(garment, range(1), self_contact=False)
    assert near < 0.1


@pytest.mark.slow
@pytest.mark.long
def test_dropped_t_shirts_settle_with_no_particles_closer_than_their_thickness_allows():
    near, wrong = drops(shirt(1600), range(20))
    assert (near >= 0.8).sum() >= 19
    assert near.min() > 0.5
    # Triangles cross at creases, where a sleeve or a corner has fallen under the rest.
    assert wrong.mean() < 0.05
    assert wrong.max() < 0.2


def test_heights_of_a_layer_are_those_of_its_triangles():
    """A plane, z = 0.1 + 0.2 x - 0.3 y, over a square less one of its halves."""
    corners = np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.3], [0.0, 1.0, -0.2]])
    points = np.array([[0.2, 0.3], [0.6, 0.6], [0.0, 0.9], [-0.1, 0.2]])
    found = heights(np.array([[0, 2, 1]]), corners, points)
    np.testing.assert_allclose(found, [0.05, np.nan, -0.17, np.nan])


def check_fold(garment: Garment, least: float) -> None:
    """Four layers, in order everywhere but at the crease and at seams, there too in most places.

    At the crease inner layers bend in a few thicknesses: cells of three thicknesses cross there,
    and now and then beyond; of cells of two thicknesses few do.
    """
    position = folded(garment, simulation_of(garment))
    points, gaps = gaps_of_layers(garment, position)
    gaps /= garment.body.material.thickness
    seams = from_seam(garment, position[:, :2], points)
    away = (points[:, 1] > fold_line(garment) + CREASE) & (seams > SEAM)
    # Half of the T-shirt is turned over, less what is near its edges.
    width, length = np.ptp(garment.body.rest[:, :2], axis=0)
    assert 1e-4 * away.sum() > 0.08 * width * length
    assert closest(garment, position) > 0.8
    assert (gaps[:, away] > 0).all()
    # Particles are held 1.05 thicknesses apart; triangles between them sag.
    assert (gaps[:, away] > 0.8).mean() > 0.99
    np.testing.assert_allclose(np.median(gaps[:, away], axis=1), 1.05, atol=0.02)
    assert (gaps > 0).all(axis=0).mean() > least


def test_four_layers_of_a_folded_doll_shirt_lie_in_order():
    check_fold(shirt(900, 0.5), least=0.9)


@pytest.mark.slow
@pytest.mark.long
def test_four_layers_of_a_folded_t_shirt_lie_in_order():
    check_fold(shirt(6000), least=0.98)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.long
def test_gradients_through_contact_of_two_sheets_equal_differences():
    """By displacements of pickers, and by the start, in the air.

    Not from rest: layers at rest touch with no gap at all, and the least move of a particle decides
    whether they do. The derivative jumps there.
    """
    garment = shirt(200, 0.5)
    body, landmarks = garment.body, garment.landmarks
    simulation = make_simulation(body, 1e-3, self_contact=True)
    pickers = make_pickers(steps=20)
    picks = jnp.asarray([[landmarks["neck"], landmarks["left_hem"]]] * 2)

    def cost(simulation, weights, position, displacement):
        actions = Actions(picks, displacement)
        final = rollout(simulation, pickers, at_rest(position), actions)[0]
        return jnp.sum(weights[0] * final.position) + jnp.sum(weights[1] * final.velocity) / 100

    # Compiled quickly: most of the time goes into that.
    jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    value, free = (
        jit(partial(cost, each)) for each in (simulation, replace(simulation, self_contact=None))
    )
    gradient = jit(jax.grad(partial(cost, simulation), (1, 2)))
    step, is_smooth = 1e-9, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        position = jnp.asarray(in_the_air(garment, seed))
        displacement = jnp.asarray(rng.uniform(-0.02, 0.02, (2, 2, 3)))
        weights = jnp.asarray(rng.standard_normal((2, body.num_particles, 3)))
        arguments = weights, position, displacement
        here, found = value(*arguments), gradient(*arguments)
        assert abs(free(*arguments) - here) > 1e-4  # they touch
        for place in range(2):
            along = [np.zeros(position.shape), np.zeros(displacement.shape)]
            along[place] = rng.standard_normal(along[place].shape)
            ahead, behind = (
                value(weights, position + move * along[0], displacement + move * along[1])
                for move in (step, -step)
            )
            # Not across a jump, where another contact is found: differences from either side tell.
            is_smooth.append(np.isclose(ahead - here, here - behind, rtol=1e-3))
            if is_smooth[-1]:
                # Rounding of the difference, 1e-15 / 1e-9, against slopes of 1 to 100.
                wanted = (ahead - behind) / (2 * step)
                np.testing.assert_allclose(np.vdot(found[place], along[place]), wanted, rtol=1e-5)
    # One of 24 was seen to be within 1e-8 of a jump.
    assert sum(is_smooth) >= 10
