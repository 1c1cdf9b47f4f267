"""Self-contact: who is near, who touches, what holds, and what it costs in gradients."""

import re
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, from_mesh, rope
from jaxsimp.dynamics import (
    NONE,
    Actions,
    Simulation,
    State,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)
from jaxsimp.dynamics.contact.contacts import Contacts
from jaxsimp.dynamics.contact.cpu import compiled
from jaxsimp.dynamics.contact.directions import across, directions
from jaxsimp.dynamics.contact.impulses import resolve
from jaxsimp.dynamics.contact.layers import find_contacts, touch
from jaxsimp.dynamics.contact.settings import (
    AHEAD,
    FEW,
    LEVEL,
    MOST_LAYERS_OF_ROPES,
    SEARCH,
    SPARE,
    make_self_contact,
)
from jaxsimp.dynamics.simulation import PHYSICS
from jaxsimp.engines import default_layout, spring_chunk_size
from jaxsimp.tasks import make_task


@pytest.fixture(params=["kernel", "definition"], autouse=True)
def path(request, monkeypatch):
    """Contact by the compiled kernel, and as it is defined in JAX."""
    if request.param == "definition":
        if request.node.get_closest_marker("slow"):
            pytest.skip("the definition takes many times as long on a CPU")
        monkeypatch.setattr(compiled, "has_kernel", lambda name, dtype: False)
    return request.param


ZERO = jnp.zeros(())
NOTHING = {
    "mass": 1.0,
    "stretch_stiffness": 1.0,
    "bend_stiffness": 0.0,
    "damping": 0.0,
    "drag": 0.0,
}


def two_pieces(first: Body, second: Body, **changes) -> Body:
    """Two bodies as one, which no spring joins."""
    count = first.num_particles
    joined = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ("rest", "mass", "families", "rest_length", "stiffness", "damping")
    }
    for name in ("springs", "faces"):
        joined[name] = np.concatenate([getattr(first, name), getattr(second, name) + count])
    return replace(
        first, **joined, shape=(count + second.num_particles,), name="two pieces", **changes
    )


def colliding_distances(simulation: Simulation, position: np.ndarray) -> np.ndarray:
    """Distances of all pairs that may touch, by brute force, in float64."""
    position = np.asarray(position, dtype=np.float64)
    now = np.linalg.norm(position[:, None] - position[None], axis=-1)
    return now[simulation.self_contact.may_touch]


# Who is near


def crumpled(body: Body, seed: int, size: float) -> np.ndarray:
    """Particles of a body anywhere in a box, shape (3, N)."""
    return np.random.default_rng(seed).uniform(0, size, (3, body.num_particles)).astype(np.float32)


def listed_pairs(contacts: Contacts) -> np.ndarray:
    """Ids of the pairs, shape (2, P); both lists have the same."""
    partner, listed_by = np.asarray(contacts.partner), np.asarray(contacts.listed_by)
    count = partner.shape[1]
    sides, first = np.nonzero(partner != np.arange(count))
    pairs = np.stack([first, partner[sides, first]])
    places, second = np.nonzero(listed_by < 2 * count)
    slots = listed_by[places, second]
    # Listed one after the other, in the order of the particles that list them.
    assert np.all(np.sort(listed_by % count * 2 + listed_by // count, axis=0)[0] >= 0)
    assert np.all((listed_by[1:] < 2 * count) <= (listed_by[:-1] < 2 * count))
    again = {(slot % count, slot // count, j) for slot, j in zip(slots, second, strict=True)}
    assert again == {(i, k, j) for k, i, j in zip(sides, *pairs, strict=True)}
    return pairs


@pytest.mark.parametrize("body", [cloth((5, 5), (0.05, 0.05)), cloth((15, 15)), rope(60, 0.3)])
@pytest.mark.parametrize("size", [0.02, 0.1])
def test_pairs_are_the_nearest_of_all(body, size):
    settings = make_self_contact(body, 1e-3)
    position = crumpled(body, 0, size)
    contacts = find_contacts(settings, jnp.asarray(position), ZERO)
    count, squash = body.num_particles, np.asarray(settings.squash)[:, None]
    normal = np.asarray(across(settings, jnp.asarray(position)))
    if not settings.is_sheet:
        normal = np.tile([[0.0], [0.0], [1.0]], count)
    away = (position[:, None] - position[:, :, None]).astype(np.float64)
    above = (normal[:, :, None] * away).sum(axis=0)
    true = np.sqrt((away**2).sum(axis=0) + squash * above**2)
    true[~settings.may_touch] = np.inf
    thickness = float(settings.thickness)
    stretch, lateral = np.sqrt(1 + squash[:, 0]), float(settings.lateral.max())
    reach = np.hypot(lateral, stretch * (thickness + float(settings.margin)))
    listed = listed_pairs(contacts)
    assert len(np.unique(np.sort(listed, axis=0), axis=1).T) == len(listed.T)  # each once
    is_listed = np.zeros((count, count), dtype=bool)
    is_listed[tuple(listed)] = is_listed[tuple(listed[::-1])] = True
    nearest, wanted = [], np.zeros((count, count), dtype=bool)
    for side in (1, -1):
        distances = np.where(side * above < -0.3 * thickness, np.inf, true)
        best = distances.min(axis=1)
        # Rounding of float32, of numbers up to 0.1, may decide who is just within reach, or nearer.
        is_best = (distances < best[:, None] + 1e-6) & (distances < reach[:, None] + 1e-6)
        assert np.all((is_best & is_listed).any(axis=1)[best < reach - 1e-6])
        wanted |= is_best
        nearest.append(np.minimum(best, reach))
    assert np.all((wanted | wanted.T)[is_listed])
    touching = np.hypot(lateral, stretch * thickness)
    squared = np.where(settings.may_touch, (away**2).sum(axis=0), np.inf)
    clear = np.minimum(np.sqrt(squared.min(axis=1)), SEARCH * reach.max())
    free = np.maximum((np.min(nearest, axis=0) - touching) / stretch, clear - touching) / 2
    np.testing.assert_allclose(contacts.allowance, np.maximum(free, settings.slack), atol=1e-6)
    position = jnp.asarray(position)
    expected = directions(settings, contacts, position, across(settings, position))
    is_pair = np.asarray(contacts.is_pair)
    differs = np.abs(expected - contacts.direction).max(axis=0)[is_pair] > 1e-4
    # Some are decided by the sign or size of something that rounding turns.
    assert differs.mean() < 0.01


@pytest.mark.parametrize("body", [cloth((9, 9), (0.1, 0.1)), rope(60, 0.3)])
def test_what_has_flown_apart_or_is_not_a_number_is_looked_up_all_the_same(body):
    settings = make_self_contact(body, 1e-3)
    position = crumpled(body, 1, 0.02)
    before = find_contacts(settings, jnp.asarray(position), ZERO)
    others = {frozenset(pair) for pair in listed_pairs(before).T.tolist() if 3 not in pair}
    assert others
    for value in (1e6, np.nan, np.inf):
        bad = position.copy()
        bad[:, 3] = value
        after = find_contacts(settings, jnp.asarray(bad), ZERO)
        found = {frozenset(pair) for pair in listed_pairs(after).T.tolist()}
        assert not any(3 in pair for pair in found)
        if np.isfinite(value):
            assert len(found & others) > 0.9 * len(others)


@pytest.mark.parametrize(
    ("common", "own", "again"),
    [(0, 0.9, False), (0, 1.1, True), (50, 0.9, False), (50, 1.1, True)],
)
def test_contacts_are_looked_up_again_when_one_moves_too_far_among_the_others(common, own, again):
    """In allowances: all move by the one, and one back and another forth by the other."""
    body = cloth((9, 9), (0.1, 0.1))
    settings = make_self_contact(body, 1e-3)
    position = jnp.asarray(crumpled(body, 2, 0.1))
    contacts = find_contacts(settings, position, ZERO)
    moved = np.asarray(position).copy()
    allowance = np.asarray(contacts.allowance)
    first, second = np.argsort(allowance)[:2]  # Both may move as far as the first.
    move = allowance[first] * np.array([0.6, 0.0, -0.8])
    moved += common * move[:, None]
    moved[:, first] += own * move
    moved[:, second] -= own * move
    nothing, zero = jnp.zeros(body.num_particles), jnp.zeros(())
    *_, after = touch(
        settings, contacts, nothing, zero, zero, jnp.asarray(moved), 0 * position, passes=0
    )
    assert np.any(after.found_at != contacts.found_at) == again


def by_side(settings, position: np.ndarray) -> np.ndarray:
    """Squared distances as the search measures them; infinite on the other side: (2, N, N)."""
    away = (position[:, None] - position[:, :, None]).astype(np.float64)
    normal = np.asarray(across(settings, jnp.asarray(position)), dtype=np.float64)
    above = (normal[:, :, None] * away).sum(axis=0) if settings.is_sheet else away[2]
    measured = (away**2).sum(axis=0) + np.asarray(settings.squash)[:, None] * above**2
    measured[~settings.may_touch | (measured >= np.square(reach_of(settings))[:, None])] = np.inf
    level = LEVEL * float(settings.thickness)
    return np.stack([np.where(side * above < -level, np.inf, measured) for side in (1, -1)])


def reach_of(settings) -> np.ndarray:
    stretch = np.sqrt(1 + np.asarray(settings.squash, dtype=np.float64))
    near = float(settings.thickness) + float(settings.margin)
    return np.hypot(float(settings.lateral.max()), stretch * near)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("body", [cloth((11, 11), (0.1, 0.1)), rope(60, 0.3)])
@pytest.mark.parametrize("seed", range(3))
def test_a_few_that_moved_are_looked_up_alone(body, seed):
    settings, rng = make_self_contact(body, 1e-3), np.random.default_rng(seed)
    before = crumpled(body, seed, 0.05).astype(np.float64)
    contacts = find_contacts(settings, jnp.asarray(before), ZERO)
    count, after = body.num_particles, before.copy()
    due = rng.choice(count, count // FEW, replace=False)
    # Half of them go far away, and half a little farther than they may.
    step = np.asarray(contacts.allowance)[due] * np.where(np.arange(len(due)) % 2, 1.01, 8.0)
    along = rng.normal(size=(3, len(due)))
    after[:, due] += step * along / np.linalg.norm(along, axis=0)
    nothing, position = jnp.zeros(count), jnp.asarray(after)
    *_, found = touch(settings, contacts, nothing, ZERO, ZERO, position, 0 * position, passes=0)
    distances, ids = by_side(settings, after), np.arange(count)
    least, farthest = distances.min(axis=2), np.square(reach_of(settings))[None]
    nearest = np.where(np.isfinite(least), distances.argmin(axis=2), ids[None])
    whole, some = np.minimum(least, farthest), distances[:, :, np.sort(due)]
    # Of the others: what they had, and what moved.
    had, known = np.asarray(contacts.nearest), np.asarray(contacts.distance).copy()
    known[np.isin(had, due)] = np.inf
    offered = some.min(axis=2)
    others = np.where(offered < known, np.sort(due)[some.argmin(axis=2)], had)
    kept = np.minimum(known, offered)
    limit = np.sqrt(contacts.distance) + np.asarray(settings.slack)
    compared = (kept > np.maximum(limit**2, contacts.distance)).any(axis=0)
    assert compared.any()
    assert (offered < known).any()
    compared[due] = True
    expected = np.where(compared, nearest, others)
    np.testing.assert_array_equal(found.nearest, expected)
    np.testing.assert_allclose(found.distance, np.where(compared, whole, kept), rtol=1e-12)
    np.testing.assert_array_equal(found.found_at[:, due], after[:, due])
    still = np.setdiff1d(ids, due)
    np.testing.assert_array_equal(found.found_at[:, still], before[:, still])
    assert np.all(found.allowance[still] <= contacts.allowance[still])
    # Any two may come nearer by what both may move, and do not touch but by twice the slack.
    room = np.asarray(found.allowance) - np.linalg.norm(after - found.found_at, axis=0)
    apart = np.linalg.norm(after[:, None] - after[:, :, None], axis=0)
    touching = np.hypot(
        float(settings.lateral.max()),
        np.sqrt(1 + np.asarray(settings.squash)) * float(settings.thickness),
    )
    spare = np.maximum(apart - np.maximum(touching, touching[:, None]), 0.0)
    squashed = (np.sqrt(by_side(settings, after).min(axis=0)) - touching[:, None]) / np.sqrt(
        1 + np.asarray(settings.squash)
    )[:, None]
    free = np.maximum(spare, np.where(np.isfinite(squashed), squashed, 0.0))
    allowed = np.maximum(np.maximum(free, free.T), 2 * float(settings.slack.max()))
    pairs = settings.may_touch[due]
    assert np.all((room[due][:, None] + room[None] <= allowed[due] + 1e-9)[pairs])


def test_contacts_last_twice_as_long_where_some_move_and_some_lie_still():
    body = cloth((9, 9), (0.1, 0.1))
    settings = make_self_contact(body, 1e-3)
    position = jnp.asarray(10 * goals.flat(body).T, jnp.float32)  # No pair is near: all may
    contacts = find_contacts(settings, position, ZERO)  # move equally far.
    allowance = float(contacts.allowance[0])
    assert np.all(contacts.allowance == allowance)
    for share, again in ((1.9, False), (2.1, True)):
        moved = position.at[1, ::2].add(share * allowance)
        nothing, zero = jnp.zeros(body.num_particles), jnp.zeros(())
        *_, after = touch(settings, contacts, nothing, zero, zero, moved, 0 * moved, passes=0)
        assert np.any(after.found_at != contacts.found_at) == again


# By kernel alone: compiled as one program, the definition rounds otherwise than operation by
# operation, and a pair that the first pass has just stopped touches in the second by rounding.
@pytest.mark.usefixtures("once", "x64")
@pytest.mark.parametrize("body", [cloth((9, 9), (0.1, 0.1)), rope(60, 0.3)])
@pytest.mark.parametrize("seed", range(5))
def test_impulses_and_pushes_are_those_that_jax_differentiates(body, seed):
    settings = make_self_contact(body, 1e-3)
    rng, count = np.random.default_rng(seed), body.num_particles
    position = jnp.asarray(crumpled(body, seed, 0.03), float)
    velocity = jnp.asarray(rng.uniform(-1, 1, position.shape))
    inverse = jnp.asarray(
        rng.uniform(0, 2, body.num_particles) * (rng.random(body.num_particles) > 0.1)
    )
    contacts = find_contacts(settings, position, ZERO)
    contacts = replace(contacts, carried=jnp.asarray(rng.integers(0, 2, count), float))
    floor, seconds = jnp.asarray(0.01), jnp.asarray(1e-3)
    *found, after = touch(settings, contacts, inverse, floor, seconds, position, velocity, passes=2)
    carried, *expected = contacts.carried, position, velocity
    for _ in range(2):
        carried, *expected, _ = resolve(
            settings, contacts, inverse, floor, seconds, carried, *expected
        )
    assert np.abs(np.asarray(expected[0] - position)).max() > 1e-4
    # Sums in another order, of float64.
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(after.carried, carried)


# Two particles: closed forms


def pair(gap: float, speed: float, *, sideways: float = 0.0, masses=(1.0, 3.0), held=False):
    """Velocities and displacements of two ropes' middle particles, one above the other."""
    one = rope(3, 0.2, **NOTHING, friction=0.4)
    body = two_pieces(one, one)
    settings = make_self_contact(body, 1e-3, top_speed=2.0)
    position = np.concatenate([one.rest, one.rest[:, [1, 0, 2]]]) + np.array([0.0, 0.0, 1.0])
    position[:3, 2] += float(settings.thickness) + gap
    velocity = np.zeros((6, 3))
    velocity[:3] = [sideways, 0, -speed]
    inverse = 1 / np.repeat(masses, 3)
    if held:
        inverse[:3] = 0
    position, velocity = jnp.asarray(position.T), jnp.asarray(velocity.T)
    contacts = find_contacts(settings, position, ZERO)
    moved, after, _ = touch(
        settings,
        contacts,
        jnp.asarray(inverse),
        jnp.asarray(0.004),
        jnp.asarray(1e-3),
        position,
        velocity,
        passes=1,
    )
    return np.asarray(moved - position), np.asarray(after), np.repeat(masses, 3)


@pytest.mark.usefixtures("x64")
def test_particles_that_meet_head_on_go_on_together():
    moved, after, mass = pair(gap=0.0, speed=1.0)
    # Perfectly inelastic: (1 * -1 + 3 * 0) / 4; the ends of the ropes do not touch.
    np.testing.assert_allclose(after[2, [1, 4]], -0.25, rtol=1e-12)
    np.testing.assert_allclose(after[2, [0, 2, 3, 5]], [-1, -1, 0, 0], atol=1e-12)
    assert np.abs(moved).max() < 1e-12
    np.testing.assert_allclose(after @ mass, [0, 0, -3], atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_particles_close_no_more_than_their_gap():
    _, after, _ = pair(gap=4e-4, speed=1.0)
    # They may approach by 0.4 mm in 1 ms.
    np.testing.assert_allclose(after[2, 4] - after[2, 1], 0.4, rtol=1e-9)
    _, after, _ = pair(gap=1.5e-3, speed=1.0)
    np.testing.assert_allclose(after[2, [1, 4]], [-1, 0], atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_particles_too_close_are_moved_apart_about_their_centre_of_mass():
    moved, after, mass = pair(gap=-1e-3, speed=0.0)
    np.testing.assert_allclose(moved[2, [1, 4]], [0.75e-3, -0.25e-3], rtol=1e-9)
    np.testing.assert_allclose(moved @ mass, 0, atol=1e-15)
    np.testing.assert_allclose(after, 0, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_what_is_held_does_not_give_way():
    _, after, _ = pair(gap=0.0, speed=1.0, held=True)
    np.testing.assert_allclose(after[2, [1, 4]], -1, rtol=1e-12)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("sideways", [0.05, 2.0])
def test_friction_is_coulombs(sideways):
    _, after, mass = pair(gap=0.0, speed=1.0, sideways=sideways)
    # Normal impulse 0.75; friction takes 0.4 of it, or half of what stops the sliding at once.
    impulse = min(0.4 * 0.75, 0.5 * 0.75 * sideways)
    np.testing.assert_allclose(after[0, [1, 4]], [sideways - impulse, impulse / 3], rtol=1e-9)
    np.testing.assert_allclose(after @ mass, [3 * sideways, 0, -3], atol=1e-12)


# Bodies


def stacked(count: int, gap: float, **changes) -> tuple[Body, np.ndarray, np.ndarray]:
    """Small cloths above each other: the body, positions, and which cloth each particle is of."""
    one = cloth((5, 5), (0.05, 0.05), mass=8e-4, **changes)
    body, position = one, one.rest
    for layer in range(1, count):
        body = two_pieces(body, one)
        # Turned a little, so that particles do not lie on particles.
        position = np.concatenate(
            [position, goals.flat(one, 0.2 * layer) + np.array([0.0, 0.0, layer * gap])]
        )
    return body, position + np.array([0.0, 0.0, one.radius]), np.repeat(np.arange(count), 25)


def test_layers_rest_on_each_other():
    body, position, layer = stacked(4, 6e-3)
    simulation = make_simulation(body, 1e-3, self_contact=True)
    final = settle(simulation, at_rest(position), 600)
    heights = [float(final.position[layer == each, 2].mean()) for each in range(4)]
    # What lies on a layer presses it in by what it falls in a step or two, 0.02 mm each.
    np.testing.assert_allclose(heights, 0.002 + SPARE * 0.004 * np.arange(4), atol=1e-4)
    assert colliding_distances(simulation, final.position).min() > 0.8 * 0.004


def test_a_sliding_layer_drags_the_one_below():
    body, position, layer = stacked(2, 4e-3, drag=0.0)
    simulation = make_simulation(body, 1e-3, self_contact=True)
    contact = replace(simulation.self_contact, friction=jnp.asarray(0.2))
    simulation = replace(simulation, friction=jnp.asarray(0.0), self_contact=contact)
    speed = np.where(layer == 1, 0.15, 0.0)[:, None] * [1.0, 0, 0]
    state = State(jnp.asarray(position, jnp.float32), jnp.asarray(speed, jnp.float32))
    # Friction 0.2 m g on either: v - 0.2 g t and 0.2 g t, until both go at v / 2 from 0.038 s.
    for steps, top, bottom in ((20, 0.15 - 0.0392, 0.0392), (80, 0.075, 0.075)):
        final = settle(simulation, state, steps)
        means = [float(final.velocity[layer == each, 0].mean()) for each in (1, 0)]
        # Contact begins one step late, and the weight is passed on step by step: 2 of 20.
        np.testing.assert_allclose(means, [top, bottom], atol=0.1 * 0.0392)


@cache
def crossing(angle: float) -> tuple[Simulation, np.ndarray]:
    """A rope above another, square to it and turned by an angle; the largest speed allowed."""
    one = rope(17, 0.2)
    body = two_pieces(one, one)
    time_step = 0.9 * largest_time_step(body)
    top_speed = MOST_LAYERS_OF_ROPES * 2 * one.radius / time_step * 0.999
    simulation = make_simulation(
        body, time_step, gravity=0.0, self_contact=True, top_speed=top_speed
    )
    turned = goals.turn(one.rest, np.pi / 2 + angle)
    return simulation, np.concatenate([one.rest, turned]) + np.array([0.0, 0.0, 1.0])


def height_of_first_over_second(position: np.ndarray) -> float:
    """Vertical distance of two ropes' middles where they cross as seen from above, or infinity."""
    first, second = (each[4:13] for each in np.split(np.asarray(position, dtype=np.float64), 2))
    for a, b in pairwise(first):
        for c, d in pairwise(second):
            matrix = np.stack([(b - a)[:2], (c - d)[:2]], axis=1)
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            s, t = np.linalg.solve(matrix, (c - a)[:2])
            if 0 <= s <= 1 and 0 <= t <= 1:
                return float((a + s * (b - a) - c - t * (d - c))[2])
    return np.inf


def with_a_long_edge(side: int) -> Body:
    """A square of triangles, and one triangle more that ends far beyond its edge."""
    sheet = cloth((side, side))
    tip = sheet.rest[side // 2] - [0.3, 0.0, 0.0]
    faces = np.append(sheet.faces, [[side // 2 + 1, side // 2, side**2]], axis=0)
    return from_mesh(np.append(sheet.rest, [tip], axis=0), faces)


@pytest.mark.usefixtures("once")
def test_which_pairs_may_touch_follows_from_what_is_near():
    side = 9
    sheet = cloth((side, side))
    with_tip, without = (
        make_self_contact(from_mesh(points, faces), 1e-3)
        for points, faces in (
            (with_a_long_edge(side).rest, with_a_long_edge(side).faces),
            (sheet.rest, sheet.faces),
        )
    )
    # All but the rows next to the tip.
    far = np.arange(4 * side, side**2)
    for name in ("lateral", "slack", "squash"):
        found, wanted = (np.asarray(getattr(each, name))[far] for each in (with_tip, without))
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
    np.testing.assert_array_equal(
        with_tip.may_touch[np.ix_(far, far)], without.may_touch[np.ix_(far, far)]
    )
    assert with_tip.lateral.max() > 5 * without.lateral.max()


def test_a_long_edge_lets_nothing_through_elsewhere():
    side = 13
    body = with_a_long_edge(side)
    position = body.rest[:-1].reshape(side, side, 3).copy()
    position[7:] = position[5::-1]  # folded along the middle row
    position[7:, :, 2] += 6e-3
    position = np.append(position.reshape(-1, 3), body.rest[-1:], axis=0)
    simulation = make_simulation(body, 2e-3, self_contact=True)
    final = settle(simulation, at_rest(position + np.array([0, 0, body.radius])), 300)
    layers = np.asarray(final.position)[:-1, 2].reshape(side, side)
    # Away from the crease and from the tip: a thickness above what was mirrored on them.
    gaps = (layers[9:] - layers[3::-1])[:, 1:-1] / (2 * body.radius)
    assert gaps.min() > 0.8
    assert gaps.max() < 1.3


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 1.0])
def test_ropes_crossed_at_speed_do_not_pass_through_each_other(share):
    rng = np.random.default_rng(0)
    run = jax.jit(partial(settle, num_steps=3))
    for _ in range(5):
        simulation, position = crossing(float(rng.choice([-0.5, 0.0, 0.4])))
        margin = float(simulation.self_contact.margin) / AHEAD
        position = position.copy()
        position[:17] += [*rng.uniform(-0.015, 0.015, 2), 0.015 + rng.uniform(0, margin)]
        velocity = np.zeros_like(position)
        velocity[:17, 2] = -share * margin / float(simulation.time_step)
        state = State(*(jnp.asarray(each, jnp.float32) for each in (position, velocity)))
        heights = []
        # For 6 cm of the way: then the upper rope has wound itself around the lower one.
        for _ in range(round(0.06 / (3 * share * margin))):
            state = run(simulation, state)
            heights.append(height_of_first_over_second(state.position))
        assert min(heights) > 0.0
        assert min(heights) < 0.01  # they have met


@pytest.mark.usefixtures("once")
def test_pickers_too_fast_for_the_thickness_are_refused():
    body = cloth((5, 5), (0.05, 0.05))
    # 1.1 of 4 mm in 1 ms.
    make_simulation(body, 1e-3, self_contact=True, top_speed=4.39)
    with pytest.raises(ValueError, match=r"4\.41 m/s; layers of 4 mm .* up to 4\.39"):
        make_simulation(body, 1e-3, self_contact=True, top_speed=4.41)
    with pytest.raises(ValueError, match=r"thickness is 0; .* give metres above zero"):
        make_self_contact(body.scaled(thickness=0.0), 1e-3)
    with pytest.raises(ValueError, match="friction is -1"):
        make_self_contact(body, 1e-3, friction=-1.0)
    fast = replace(make_task("cloth_side_folding", quick=True), action_seconds=0.05)
    with pytest.raises(ValueError, match="longer actions"):
        fast.simulation(self_contact=True)


def test_contacts_that_got_past_each_other_are_counted():
    body, position, layer = stacked(2, 4e-3)
    simulation = make_simulation(body, 1e-3, gravity=0.0, self_contact=True)
    slow = np.where(layer == 1, -1.0, 0.0)[:, None] * [0, 0, 1.0]
    position[layer == 1, 2] += 4e-3
    state = State(jnp.asarray(position, jnp.float32), jnp.asarray(slow, jnp.float32))
    assert int(settle(simulation, state, 20).missed) == 0
    # 50 m/s: twelve thicknesses in a time step, where one is allowed.
    assert int(settle(simulation, replace(state, velocity=50 * state.velocity), 3).missed) > 0


FOLDS = {
    "sides": (((0, 24), (600, 624)), ((600, 300), (624, 324))),
    "corners": (((0, NONE), (624, NONE)), ((24, NONE), (600, NONE))),
}
"""Particles grasped, and those they are carried towards, in two folds of a cloth of 25 x 25."""


def over(start: np.ndarray, end: np.ndarray, lift: float) -> np.ndarray:
    """Displacements that carry something up, over and down, in four actions."""
    up, down = (end - start) / 2 + [0, 0, lift], (end - start) / 2 - [0, 0, lift - 0.006]
    return np.stack([up / 2, up / 2, down / 2, down / 2])


@pytest.mark.slow
def test_twice_folded_cloths_settle_with_no_particles_closer_than_their_thickness_allows():
    """A stack never lies quite still, and which pair comes how close is chance: a rate is asserted.

    Of 200 such cloths 2 have a pair closer than 80 % of the thickness (docs/physics.md). At that
    rate more than 2 of 20 have one with a probability of 0.1 %; where one in three has, 2 or fewer
    of 20 do with 2 %.
    """
    body = cloth()
    simulation = make_simulation(body, 0.9 * largest_time_step(body), self_contact=True)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=127)
    run = jax.jit(lambda state, actions: rollout(simulation, pickers, state, actions)[0])
    closest = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        state = at_rest(goals.flat(body, rng.uniform(-np.pi / 4, np.pi / 4)))
        share, lift = rng.uniform(0.8, 1.0), rng.uniform(0.06, 0.14)
        for picks, targets in FOLDS[("sides", "corners")[seed % 2]]:
            position = np.asarray(state.position)
            moves = np.zeros((8, 2, 3))
            for picker, (pick, target) in enumerate(zip(picks, targets, strict=True)):
                end = position[pick] + share * (position[target] - position[pick])
                moves[:4, picker] = 0 if pick == NONE else over(position[pick], end, lift)
            grasped = np.tile(picks, (8, 1))
            grasped[4:] = NONE
            state = run(state, Actions(jnp.asarray(grasped), jnp.asarray(moves, jnp.float32)))
        assert np.ptp(state.position[:, 2]) > 3 * 2 * body.radius  # four layers
        closest.append(colliding_distances(simulation, state.position).min() / (2 * body.radius))
    assert np.sum(np.array(closest) < 0.8) <= 2
    # Nobody passes through: the closest of the 200 is at 69 %.
    assert min(closest) > 0.5


# Transformations


def colliding_rollout(simulation, pickers, state, displacement):
    """The second of two ropes' ends, laid over the first."""
    actions = Actions(jnp.asarray([[17, NONE]]), displacement[None])
    return rollout(simulation, pickers, state, actions)[0]


@cache
def laid_over():
    one = rope(9, 0.1)
    body = two_pieces(one, one)
    simulation = make_simulation(body, 1e-3, self_contact=True)
    position = np.concatenate(
        [one.rest, goals.turn(one.rest, 1.3) + np.array([0.003, 0.002, 0.0085])]
    )
    position[:, 2] += one.radius
    displacement = np.zeros((2, 3))
    displacement[0] = [0.01, 0.015, -0.004]
    return simulation, make_pickers(steps=20), position, displacement


@pytest.mark.usefixtures("once", "x64")  # both paths are compared with JAX's derivative below
def test_gradients_through_contact_are_those_of_finite_differences():
    laid_over.cache_clear()
    simulation, pickers, position, displacement = laid_over()
    laid_over.cache_clear()  # of float64
    position = jnp.asarray(position)

    def cost(height, displacement, friction):
        contact = replace(simulation.self_contact, friction=friction)
        changed = replace(simulation, self_contact=contact)
        start = at_rest(position.at[9:, 2].add(height))
        final = colliding_rollout(changed, pickers, start, displacement)
        loss = jnp.sum(final.position[:, 0] ** 2) + jnp.sum(final.position[:9] * position[9:])
        return loss, final.position

    arguments = (jnp.asarray(0.0), jnp.asarray(displacement), jnp.asarray(0.02))
    # Compiled quickly: most of the time goes into that.
    jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    value = jit(cost)
    gradients, held = jit(jax.grad(cost, (0, 1, 2), has_aux=True))(*arguments)
    assert all(np.all(np.isfinite(each)) for each in gradients)
    without = replace(simulation, self_contact=None)
    free = colliding_rollout(without, pickers, at_rest(position), arguments[1])
    assert np.abs(free.position - held).max() > 1e-4  # they touch
    rng = np.random.default_rng(0)
    for _ in range(3):
        along = [rng.standard_normal(np.shape(each)) for each in arguments]
        step = 1e-7
        ahead, behind = (
            value(*(a + sign * step * d for a, d in zip(arguments, along, strict=True)))[0]
            for sign in (1, -1)
        )
        expected = sum(np.vdot(g, d) for g, d in zip(gradients, along, strict=True))
        # Rounding of the difference, 1e-16 / 1e-7, against gradients of order 1e-2.
        np.testing.assert_allclose((ahead - behind) / (2 * step), expected, rtol=1e-5, atol=1e-8)


def test_a_batch_is_its_samples_and_the_same_each_time():
    simulation, pickers, position, displacement = laid_over()
    state = at_rest(position)
    several = jnp.asarray(np.stack([displacement, -displacement, 0.5 * displacement]), jnp.float32)
    run = jax.jit(partial(colliding_rollout, simulation, pickers, state))
    single = [run(each) for each in several]
    batch = jax.jit(jax.vmap(partial(colliding_rollout, simulation, pickers, state)))(several)
    for index, each in enumerate(single):
        # 20 steps from the same floats in another order of operations.
        np.testing.assert_allclose(batch.position[index], each.position, atol=1e-6)
        again = run(several[index])
        np.testing.assert_array_equal(again.position, each.position)
        np.testing.assert_array_equal(again.missed, each.missed)


def test_without_self_contact_nothing_of_it_is_compiled():
    simulation, pickers, position, displacement = laid_over()
    plain = replace(simulation, self_contact=None)
    actions = jnp.asarray(displacement, jnp.float32)
    run = partial(colliding_rollout, plain, pickers, at_rest(position))
    lowered = jax.jit(run).lower(actions)
    assert "jaxsimp_touch" not in lowered.as_text()
    assert jax.jit(run)(actions).missed == 0


@pytest.mark.usefixtures("once")
def test_samples_that_touch_themselves_run_one_by_one():
    body = rope(9, 0.1)
    touching, passing = (make_simulation(body, 1e-3, self_contact=each) for each in (True, False))
    assert default_layout(64, spring_chunk_size(touching)).chunk_size == 1
    assert default_layout(64, spring_chunk_size(passing)).chunk_size > 1


# Two paths, one function


def fold_by_hand(side: int, self_contact: bool = True):
    """A cloth whose one edge is carried over to the other and let go: about 500 time steps."""
    body = cloth((side, side))
    simulation = make_simulation(body, 1.9e-3, self_contact=self_contact)
    moves, picks = np.zeros((4, 2, 3)), np.full((4, 2), NONE)
    moves[:2, :, 0], moves[0, :, 2], moves[1, :, 2] = 0.145, 0.1, -0.094
    picks[:2] = [0, side - 1]
    actions = Actions(jnp.asarray(picks), jnp.asarray(moves, float))
    return simulation, make_pickers((0.2, 0.2, 0.2), steps=125), at_rest(goals.flat(body)), actions


@pytest.fixture
def once(path):
    """One path is enough: the test compares both, or says nothing of how contact is computed."""
    if path == "definition":
        pytest.skip("runs once")


def compared(run, monkeypatch):
    """Results of the kernel and of the definition."""
    # Optimised, as for users: reciprocal roots are less exact otherwise, to 1e-4 of float32's.
    options = {"xla_backend_optimization_level": 3}
    found = jax.jit(run, compiler_options=options)()
    monkeypatch.setattr(compiled, "has_kernel", lambda name, dtype: False)
    return found, jax.jit(lambda: run(), compiler_options=options)()


@pytest.mark.usefixtures("once")
@pytest.mark.parametrize(("real", "metres"), [("float32", 1e-7), ("float64", 1e-12)])
def test_kernel_and_definition_agree_over_a_fold(real, metres, monkeypatch):
    with jax.enable_x64(real == "float64"):
        simulation, pickers, start, actions = fold_by_hand(11)
        run = partial(rollout, simulation, pickers, start, actions)
        found, wanted = compared(lambda: run()[0], monkeypatch)
        assert np.ptp(found.position[:, 2]) > 2 * float(simulation.radius)  # two layers
        np.testing.assert_allclose(found.position, wanted.position, rtol=0, atol=metres)


@cache
def folded():
    """Positions after `fold_by_hand`, in float64: contacts are there from the start."""
    simulation, pickers, start, actions = fold_by_hand(5)
    return rollout(simulation, pickers, start, actions)[0].position


@cache
def slopes_of_a_fold(adjoint: bool, path: str):
    """Of a weighted sum of the end, by all numbers of the simulation, the start and the moves."""
    simulation, _, _, actions = fold_by_hand(5)
    actions = jax.tree.map(lambda array: array[:2], actions)
    pickers = make_pickers((0.2, 0.2, 0.2), steps=60)
    weights = jnp.asarray(np.random.default_rng(0).standard_normal(folded().shape))

    def cost(numbers, position, displacement):
        *own, friction, thickness = numbers
        contact = replace(simulation.self_contact, friction=friction, thickness=thickness)
        changed = replace(simulation, self_contact=contact, **dict(zip(PHYSICS, own, strict=True)))
        plan, begun = Actions(actions.pick, displacement), at_rest(position)
        final = rollout(changed, pickers, begun, plan, adjoint=adjoint)[0]
        return jnp.sum(weights * (final.position + 0.01 * final.velocity))

    contact = simulation.self_contact
    own = [getattr(simulation, name) for name in PHYSICS]
    arguments = [*own, contact.friction, contact.thickness], folded(), actions.displacement
    return jax.tree.leaves(jax.jit(jax.grad(cost, (0, 1, 2)))(*arguments))


@pytest.mark.usefixtures("x64")
def test_the_adjoint_is_the_derivative_that_jax_takes(path):
    # That of JAX alone is the same on both paths.
    found, wanted = slopes_of_a_fold(True, path), slopes_of_a_fold(False, "either")
    assert all(np.any(leaf != 0) for leaf in wanted)  # they rub, and press
    for one, other in zip(found, wanted, strict=True):
        # Rounding, in sums over 160 steps.
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
@pytest.mark.usefixtures("once")
def test_memory_of_a_gradient_grows_with_the_square_root_of_the_steps():
    simulation, _, start, actions = fold_by_hand(5)

    def memory(steps: int) -> int:
        pickers = make_pickers((0.2, 0.2, 0.2), steps=steps)

        def cost(displacement):
            plan = Actions(actions.pick[:1], displacement)
            return rollout(simulation, pickers, start, plan)[0].position.sum()

        lowered = jax.jit(jax.grad(cost)).lower(actions.displacement[:1])
        return lowered.compile().memory_analysis().temp_size_in_bytes

    # Sixteen times the steps: four times the states, and something that does not grow.
    assert memory(1024) <= 4.2 * memory(64)


def test_a_busy_sample_looks_up_for_itself_alone():
    """A batch of samples, of which some are due: contacts are those of each by itself."""
    body = cloth((9, 9), (0.1, 0.1))
    settings = make_self_contact(body, 1e-3)
    still = jnp.asarray(crumpled(body, 2, 0.05))
    contacts = find_contacts(settings, still, ZERO)
    moved = jnp.stack([still, still.at[0, ::2].add(0.03), still, still.at[2, :40].add(-0.02)])
    nothing = jnp.zeros(body.num_particles)

    def one(position):
        return touch(settings, contacts, nothing, ZERO, ZERO, position, 0 * position, passes=0)[2]

    found = jax.jit(jax.vmap(one))(moved)
    np.testing.assert_array_equal(found.renewed.any(axis=(1, 2)), [False, True, False, True])
    for index, position in enumerate(moved):
        alone = one(position)
        for name in ("nearest", "distance", "partner", "listed_by", "found_at", "allowance"):
            np.testing.assert_allclose(getattr(found, name)[index], getattr(alone, name), atol=1e-7)


@pytest.mark.usefixtures("once")
def test_a_control_loop_is_a_scan_over_rollouts():
    """A state goes in and comes out, under vmap and grad."""
    simulation, pickers, position, _ = laid_over()
    action = Actions(jnp.asarray([[17, NONE]]), jnp.zeros((1, 2, 3)))

    def cost(simulation, move):
        def act(state, _):
            toward = move * (state.position[17] - state.position[3])
            plan = replace(action, displacement=action.displacement.at[0, 0].set(toward))
            state, _ = rollout(simulation, pickers, state, plan)
            return state, state.missed

        final, missed = jax.lax.scan(act, at_rest(position), length=3)
        return final.position[17, 0], missed

    run = jax.value_and_grad(partial(cost, simulation), has_aux=True)
    (ends, missed), slopes = jax.jit(jax.vmap(run))(jnp.asarray([0.1, 0.3]))
    assert missed.shape == (2, 3)
    assert np.all(np.isfinite(slopes))
    assert np.all(slopes != 0)
    assert ends[0] != ends[1]
    # The same tree without contact.
    plain = replace(simulation, self_contact=None)
    trees = []

    def settled(each):
        leaves, tree = jax.tree.flatten(settle(each, at_rest(position), 1))
        trees.append(tree)
        return leaves

    for each in (simulation, plain):
        jax.eval_shape(settled, each)
    assert trees[0] == trees[1] == jax.tree.structure(at_rest(position))


@pytest.mark.usefixtures("once")
def test_what_is_compiled_for_a_gpu_calls_nothing_of_a_cpu():
    simulation, pickers, position, displacement = laid_over()
    run = partial(colliding_rollout, simulation, pickers, at_rest(position))
    several = jnp.asarray(np.stack([displacement] * 3), jnp.float32)
    gradient = jax.grad(lambda displacement: run(displacement).position.sum())
    for function in (run, gradient):
        traced = jax.jit(jax.vmap(function)).trace(several)
        text = traced.lower(lowering_platforms=("cuda",)).as_text()
        assert "jaxsimp" not in text
        assert "custom_call" not in text
        # No sums in an order that a GPU does not fix. But for those of pickers (of several at a
        # particle, one alone moves it; the others add zeros).
        scatters = re.findall(r'"stablehlo\.scatter".*?stablehlo\.return', text, re.DOTALL)
        sums = [each for each in scatters if "stablehlo.add" in each]
        assert len(sums) == (function is gradient)
        assert "jaxsimp_touch" in traced.lower(lowering_platforms=("cpu",)).as_text()
