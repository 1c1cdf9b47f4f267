"""Bodies: what they are made of, counted and measured in closed form, and what they refuse."""

import copy
import pickle
from dataclasses import replace
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, from_mesh, rope, rope_along, towel
from jaxsimp.bodies.meshes import face_areas
from jaxsimp.bodies.outlines import mesh_outline
from jaxsimp.dynamics import (
    Actions,
    at_rest,
    largest_time_step,
    make_pickers,
    make_simulation,
    rollout,
    settle,
)

# Sums and differences of a few hundred float64 numbers of size 1.
ROUNDING = 1e-13

counts = st.integers(2, 9)
extents = st.floats(0.01, 3.0)


def pairs_of(body: Body) -> set[frozenset[int]]:
    return {frozenset(pair) for pair in body.springs.tolist()}


@given(num_particles=st.integers(2, 60), length=extents, mass=extents)
def test_a_rope_is_a_line_of_equal_particles(num_particles, length, mass):
    body = rope(num_particles, length, mass=mass)
    spacing = length / (num_particles - 1)
    x = -length / 2 + spacing * np.arange(num_particles)
    np.testing.assert_allclose(body.rest[:, 0], x, atol=ROUNDING * 3)
    np.testing.assert_array_equal(body.rest[:, 1:], 0.0)
    np.testing.assert_allclose(body.mass.sum(), mass, rtol=ROUNDING)
    np.testing.assert_allclose(body.size, length, rtol=ROUNDING)
    # A difference of two coordinates near length / 2.
    np.testing.assert_allclose(body.spacing, spacing, rtol=num_particles * ROUNDING)
    assert body.num_particles == num_particles
    assert body.shape == (num_particles,)
    assert body.faces.shape == (0, 3)


@given(num_particles=st.integers(2, 30))
def test_a_rope_has_a_spring_for_each_pair_one_or_two_apart(num_particles):
    body = rope(num_particles, 1.0, stretch_stiffness=3.0, bend_stiffness=2.0)
    expected = {1: 3.0, 2: 2.0}
    wanted = {
        frozenset((i, j)): expected[j - i]
        for i, j in combinations(range(num_particles), 2)
        if j - i in expected
    }
    assert len(body.springs) == len(wanted)
    assert dict(zip(map(frozenset, body.springs.tolist()), body.stiffness, strict=True)) == wanted
    gaps = np.ptp(body.springs, axis=1) / (num_particles - 1)
    np.testing.assert_allclose(body.rest_length, gaps, rtol=num_particles * ROUNDING)


@given(rows=counts, columns=counts)
def test_cloth_spring_counts(rows, columns):
    body = cloth(
        (rows, columns), (0.3, 0.2), stretch_stiffness=1.0, shear_stiffness=2.0, bend_stiffness=3.0
    )
    stretch, shear, bend = (int((body.stiffness == k).sum()) for k in (1.0, 2.0, 3.0))
    assert stretch == rows * (columns - 1) + (rows - 1) * columns
    assert shear == 2 * (rows - 1) * (columns - 1)
    assert bend == rows * (columns - 2) + (rows - 2) * columns
    assert len(pairs_of(body)) == len(body.springs) == stretch + shear + bend


@given(rows=counts, columns=counts)
def test_cloth_springs_join_the_pairs_that_their_kind_says(rows, columns):
    body = cloth((rows, columns), stretch_stiffness=1.0, shear_stiffness=2.0, bend_stiffness=3.0)
    kind = {(0, 1): 1.0, (1, 0): 1.0, (1, 1): 2.0, (0, 2): 3.0, (2, 0): 3.0}
    wanted = {}
    for i, j in combinations(range(rows * columns), 2):
        apart = (abs(i // columns - j // columns), abs(i % columns - j % columns))
        if apart in kind:
            wanted[frozenset((i, j))] = kind[apart]
    assert dict(zip(map(frozenset, body.springs.tolist()), body.stiffness, strict=True)) == wanted


@given(shape=st.tuples(counts, counts), size=st.tuples(extents, extents), mass=extents)
def test_a_cloth_is_a_centred_grid_of_its_size_and_mass(shape, size, mass):
    body = cloth(shape, size, mass=mass)
    grid = body.rest.reshape(*shape, 3)
    steps = np.array(size) / (np.array(shape) - 1)
    for i, j in np.ndindex(*shape):
        at = np.array([i, j]) * steps - np.array(size) / 2
        np.testing.assert_allclose(grid[i, j], [*at, 0.0], atol=3 * ROUNDING)
    np.testing.assert_allclose(body.mass.sum(), mass, rtol=ROUNDING)
    np.testing.assert_allclose(body.size, max(size), rtol=ROUNDING)
    ends = body.rest[body.springs]
    np.testing.assert_allclose(
        body.rest_length, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1), rtol=ROUNDING
    )


@given(shape=st.tuples(counts, counts), size=st.tuples(extents, extents))
def test_cloth_triangles_tile_the_rectangle_and_face_up(shape, size):
    body = cloth(shape, size)
    a, b, c = body.rest[body.faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0).all()
    np.testing.assert_allclose(normal[:, 2].sum() / 2, size[0] * size[1], rtol=1e-10)
    edges = {frozenset(pair) for face in body.faces.tolist() for pair in combinations(face, 2)}
    # Euler's formula for a disc: together with the area, a tiling without holes or overlaps.
    assert body.num_particles - len(edges) + len(body.faces) == 1


# --- ropes along points --------------------------------------------------------------------------


@given(num_particles=st.integers(2, 20), seed=st.integers(0, 10**6))
def test_a_rope_along_points_is_at_rest_there(num_particles, seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (num_particles, 3))
    body = rope_along(points, mass=0.5)
    moved = points - body.rest
    np.testing.assert_allclose(moved, np.tile(moved[0], (num_particles, 1)), atol=ROUNDING)
    np.testing.assert_allclose(body.rest[:, 2].min(), 0.0, atol=ROUNDING)
    middle = (body.rest.min(axis=0) + body.rest.max(axis=0))[:2]
    np.testing.assert_allclose(middle, 0.0, atol=ROUNDING)
    assert pairs_of(body) == pairs_of(rope(num_particles, 1.0))
    ends = points[body.springs]
    np.testing.assert_allclose(
        body.rest_length, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1), rtol=1e-9
    )
    np.testing.assert_allclose(body.mass, 0.5 / num_particles, rtol=ROUNDING)


def test_a_rope_along_points_refuses_too_few_and_coinciding_ones():
    with pytest.raises(ValueError, match="num_particles is 1; give a whole number from 2"):
        rope_along(np.zeros((1, 3)))
    with pytest.raises(
        ValueError, match=r"particles 0 and 1 of the rope are at the same place \(2 such"
    ):
        rope_along(np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"points\[\d\] is .*give finite numbers, in m"):
        rope_along(np.array([[0.0, 0.0, 0.0], [0.1, np.nan, 0.0]]))


# --- meshes --------------------------------------------------------------------------------------

STRIP = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.1], [0.0, 0.1]])
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def ball() -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    return np.array(solid.vertices), np.array(solid.faces)


@given(density=st.floats(0.05, 2.0), seed=st.integers(0, 10**6))
def test_the_mass_of_a_mesh_is_its_area_times_its_density(density, seed):
    points, faces = ball()
    points += np.random.default_rng(seed).uniform(-0.02, 0.02, points.shape)
    body = from_mesh(points, faces, density=density)
    area = face_areas(points, faces)
    np.testing.assert_allclose(body.mass.sum(), density * area.sum(), rtol=1e-12)
    for particle in (0, 50):  # a third of each of its triangles
        own = area[(faces == particle).any(axis=1)].sum()
        np.testing.assert_allclose(body.mass[particle], density * own / 3, rtol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_a_mesh_lies_centred_on_the_table_wherever_it_came_from(seed):
    points, faces = ball()
    shift = np.random.default_rng(seed).uniform(-3, 3, 3)
    body, moved = from_mesh(points, faces), from_mesh(points + shift, faces)
    np.testing.assert_allclose(moved.rest, body.rest, atol=10 * ROUNDING)
    assert body.rest[:, 2].min() == 0.0
    extent = body.rest.max(axis=0) + body.rest.min(axis=0)
    np.testing.assert_allclose(extent[:2], 0.0, atol=ROUNDING)
    assert body.shape == (len(points),)


def test_a_mesh_has_its_particles_and_triangles_in_order():
    points, faces = mesh_outline(STRIP, 60)
    body = from_mesh(points * 1000, faces, scale=1e-3, name="strip")
    np.testing.assert_allclose(body.rest, points - [0.2, 0.05, 0.0], atol=ROUNDING)
    np.testing.assert_array_equal(body.faces, faces)
    assert body.name == "strip"
    edges = {frozenset(pair) for face in faces.tolist() for pair in combinations(face, 2)}
    assert edges < pairs_of(body)
    inner = 3 * len(faces) - len(edges)  # edges of two triangles, with a spring across each
    assert len(body.springs) == len(edges) + inner


@pytest.mark.parametrize("make", [lambda: mesh_outline(STRIP, 80), ball], ids=["strip", "ball"])
def test_a_mesh_at_rest_stays_at_rest(make):
    body = from_mesh(*make())
    simulation = make_simulation(body, 1e-3, gravity=0.0)
    start = body.rest + np.array([0.0, 0.0, body.radius])
    end = settle(simulation, at_rest(start), 200)
    # Float32 errs by 1e-8 m in coordinates of 0.1 m: in 0.2 s far less than a micrometre.
    np.testing.assert_allclose(end.position, start, atol=1e-6)


def pulled_modulus(body: Body) -> float:
    """Force per width over strain of a strip pulled along x between clamps free in y, N/m.

    The static problem of small strains, solved as a dense linear system.
    """
    count, at = body.num_particles, body.rest[:, :2]
    stiffness = np.zeros((count, 2, count, 2))
    for (i, j), k in zip(body.springs.tolist(), body.stiffness, strict=True):
        along = (at[j] - at[i]) / np.linalg.norm(at[j] - at[i])
        block = k * np.outer(along, along)
        stiffness[i, :, i] += block
        stiffness[j, :, j] += block
        stiffness[i, :, j] -= block
        stiffness[j, :, i] -= block
    stiffness = stiffness.reshape(2 * count, 2 * count)
    length, width = np.ptp(at, axis=0)
    low, high = (np.flatnonzero(np.isclose(at[:, 0], end * length / 2)) for end in (-1, 1))
    moves = np.zeros(2 * count)
    moves[2 * high] = length  # a strain of 1, of the linear problem
    held = np.concatenate([2 * low, 2 * high, [2 * low[0] + 1]])
    free = np.setdiff1d(np.arange(2 * count), held)
    load = -stiffness[np.ix_(free, held)] @ moves[held]
    moves[free] = np.linalg.solve(stiffness[np.ix_(free, free)], load)
    return float((stiffness @ moves)[2 * high].sum() / width)


@pytest.mark.parametrize("num_points", [60, 120, 400])
def test_a_strip_stretches_alike_however_finely_it_is_meshed(num_points):
    points, faces = mesh_outline(STRIP, num_points)
    stretch = from_mesh(points, faces, stretch_stiffness=4.0, bend_stiffness=0.0)
    # Young's modulus of equilateral triangles; those of the mesh are nearly so.
    assert pulled_modulus(stretch) == pytest.approx(4.0, rel=0.03)
    both = from_mesh(points, faces, stretch_stiffness=4.0, bend_stiffness=0.5)
    # Springs across edges are missing along the boundary, which is long in a coarse strip.
    assert pulled_modulus(both) == pytest.approx(4.5, rel=0.04)


@pytest.mark.parametrize("side", [0.3, 0.5, 0.7])
def test_a_usual_mesh_is_stable_at_a_millisecond(side):
    body = from_mesh(*mesh_outline(side * SQUARE, 625))
    assert largest_time_step(body) >= 1e-3
    # A sheet like `cloth`, of the same size and resolution: not far from its time step.
    assert largest_time_step(body) >= 0.5 * largest_time_step(cloth((25, 25), (side, side)))


def test_damping_and_stiffness_are_the_sheet_s():
    points, faces = mesh_outline(STRIP, 60)
    body = from_mesh(points, faces, stretch_stiffness=2.0, bend_stiffness=1.0, damping=0.5)
    twice = from_mesh(points, faces, stretch_stiffness=4.0, bend_stiffness=3.0, damping=1.0)
    np.testing.assert_allclose(twice.damping, 2 * body.damping, rtol=1e-12)
    assert set((twice.stiffness / body.stiffness).round(9).tolist()) == {2.0, 3.0}
    bends = np.isclose(twice.stiffness / body.stiffness, 3.0)
    np.testing.assert_allclose(body.damping[bends], 0.5 * body.stiffness[bends], rtol=1e-12)
    np.testing.assert_allclose(body.damping[~bends], 0.25 * body.stiffness[~bends], rtol=1e-12)


def test_a_picker_carries_a_mesh():
    body = from_mesh(*mesh_outline(STRIP, 60))
    simulation = make_simulation(body, 2e-3)
    corner = 2  # of the outline
    actions = Actions(jnp.array([[corner]]), jnp.array([[[0.05, 0.0, 0.08]]]))
    start = goals.flat(body)
    end, _ = rollout(simulation, make_pickers(), at_rest(start), actions)
    # Float32 sums of 150 steps.
    np.testing.assert_allclose(end.position[corner], start[corner] + [0.05, 0, 0.08], atol=1e-5)
    assert np.isfinite(end.position).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"density": 0.0}, "density is 0.0; give a number from 1e-06 to 1e\\+06 kg/m"),
        ({"density": float("nan")}, "density is nan"),
        ({"stretch_stiffness": -1.0}, "stiffness is -"),
        ({"damping": -1.0}, "damping is -"),
        ({"friction": -1.0}, "friction is -1"),
        ({"thickness": float("inf")}, "thickness is inf"),
        ({"scale": 0.0}, "scale is 0.0; give .* the metres in one unit"),
        ({"scale": 1000.0}, "of the mesh is 400 m; a body is"),
    ],
)
def test_from_mesh_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        from_mesh(*mesh_outline(STRIP, 60), **arguments)


ARRAYS = ("rest", "mass", "springs", "families", "rest_length", "stiffness", "damping", "faces")


@pytest.mark.parametrize(
    "made",
    [
        lambda body: body,
        lambda body: pickle.loads(pickle.dumps(body)),
        copy.copy,
        copy.deepcopy,
        lambda body: replace(body, name="other"),
        lambda body: body.scaled(drag=2.0),
    ],
    ids=["made", "pickled", "copied", "copied deeply", "replaced", "scaled"],
)
def test_arrays_are_read_only_and_the_body_s_own(made):
    body = cloth((3, 3))
    found = made(body)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(body, name))
        assert getattr(found, name).dtype == getattr(body, name).dtype
        with pytest.raises(ValueError, match="read-only"):
            getattr(found, name)[0] = 0
        assert getattr(found, name).base is None  # which could be written to


def test_a_pickled_body_is_the_same():
    body = towel(num_particles=60, drag=2.5).body
    found = pickle.loads(pickle.dumps(body))
    assert (found.name, found.material, found.shape) == (body.name, body.material, body.shape)


def test_arrays_of_the_caller_stay_writable_and_apart():
    given = {name: np.array(getattr(cloth((3, 3)), name)) for name in ARRAYS}
    body = replace(cloth((3, 3)), **given)
    for name, array in given.items():
        before = getattr(body, name).copy()
        array[...] = 7
        np.testing.assert_array_equal(getattr(body, name), before)


def test_one_particle_without_springs_is_a_body():
    body = replace(
        rope(2, 1.0),
        rest=np.zeros((1, 3)),
        mass=np.ones(1),
        springs=np.zeros((0, 2), dtype=int),
        families=np.zeros(0, dtype=int),
        rest_length=np.zeros(0),
        stiffness=np.zeros(0),
        damping=np.zeros(0),
    )
    assert body.num_particles == 1
    assert body.size == 0.0


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_particles": 1}, "num_particles is 1; give a whole number from 2"),
        ({"num_particles": 0}, "num_particles is 0; give a whole number from 2"),
        ({"length": 0.0}, "length is 0 m; a body is 0.01 to 5 m large"),
        ({"length": -1.0}, "length is -1"),
        ({"length": NAN}, "length is nan"),
        ({"length": INF}, "length is inf"),
        ({"mass": 0.0}, "mass is 0"),
        ({"mass": -1.0}, "mass is -1"),
        ({"mass": NAN}, "mass is nan"),
        ({"stretch_stiffness": -3.0}, "stiffness is -3.0; give a number from 0 to 1e\\+09 N/m"),
        ({"bend_stiffness": NAN}, "bend_stiffness is nan; give a number from 0"),
        ({"damping": -0.1}, "damping is -0.1"),
        ({"drag": -1.0}, "drag is -1"),
        ({"drag": INF}, "drag is inf"),
        ({"friction": -0.5}, "friction is -0.5"),
        ({"friction": NAN}, "friction is nan"),
        ({"friction": INF}, "friction is inf"),
        ({"thickness": -0.1}, "thickness is -0.1"),
        ({"thickness": INF}, "thickness is inf"),
        ({"shear_stiffness": 1.0}, "shear_stiffness is 1; a rope has no shear springs: give 0"),
    ],
)
def test_a_rope_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        rope(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shape": (1, 5)}, "shape is 1; give a whole number of at least 2"),
        ({"shape": (5, 0)}, "shape is 0; give a whole number of at least 2"),
        ({"size": (0.0, 0.3)}, "size is 0"),
        ({"size": (0.3, -0.3)}, "size is -0.3"),
        ({"size": (0.3, INF)}, "size is inf"),
        ({"mass": -1.0}, "mass is -1"),
        ({"shear_stiffness": -3.0}, "stiffness is -3"),
        ({"stretch_stiffness": INF}, "stretch_stiffness is inf"),
    ],
)
def test_a_cloth_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        cloth(**arguments)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"rest": np.zeros((3, 2))}, r"rest has shape \(3, 2\); give shape \(N, 3\)"),
        ({"rest": np.zeros((0, 3))}, "num_particles is 0; give a whole number from 1"),
        ({"rest": np.full((3, 3), NAN)}, r"rest\[0, 0\] is nan; give numbers"),
        ({"mass": np.ones(4)}, r"mass has shape \(4,\); give shape \(3,\), for 3 part"),
        (
            {"mass": np.array([1.0, 0.0, 1.0])},
            r"mass\[1\] is 0; give numbers from 1e-12 to 1000 kg",
        ),
        ({"mass": np.array([1.0, INF, 1.0])}, r"mass\[1\] is inf"),
        (
            {"springs": np.zeros((3, 3), dtype=int)},
            r"springs has shape \(3, 3\); give shape \(S, 2\)",
        ),
        (
            {"springs": np.array([[0, 1], [1, 2], [0, 3]])},
            "springs names 3; the ids of 3 particles are 0",
        ),
        ({"springs": np.array([[0, 1], [1, 2], [0, -1]])}, "springs names -1"),
        ({"springs": np.array([[0, 1], [1, 2], [2, 2]])}, r"spring \[2, 2\] joins a particle to"),
        ({"springs": np.array([[0, 1], [1, 2], [1, 0]])}, r"spring \[0, 1\] is there twice"),
        ({"families": np.zeros(2, dtype=int)}, r"families has shape \(2,\); give shape \(3,\)"),
        ({"families": np.array([0, 3, 0])}, "families is 3 for spring 1; give 0 for stretch"),
        ({"families": np.array([0, 0, -1])}, "families is -1 for spring 2"),
        ({"rest_length": np.ones(2)}, r"rest_length has shape \(2,\); give shape \(3,\)"),
        ({"rest_length": np.array([0.0, 1.0, 1.0])}, r"rest_length\[0\] is 0"),
        ({"stiffness": np.array([1.0, -2.0, 1.0])}, r"stiffness\[1\] is -2"),
        ({"damping": np.array([1.0, -2.0, 1.0])}, r"damping\[1\] is -2"),
        ({"faces": np.zeros((1, 2), dtype=int)}, r"faces has shape \(1, 2\); give shape \(F, 3\)"),
        ({"faces": np.array([[0, 1, 7]])}, "faces names 7; the ids of 3 particles are 0 to 2"),
    ],
)
def test_a_body_refuses(arrays, message):
    with pytest.raises(ValueError, match=message):
        replace(rope(3, 1.0), **arrays)
