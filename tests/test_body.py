"""Bodies: what they are made of, counted and measured in closed form, and what they refuse."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.body import Body, cloth, rope

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


def test_arrays_are_read_only():
    body = cloth((3, 3))
    for name in ("rest", "mass", "springs", "rest_length", "stiffness", "damping", "faces"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(body, name)[0] = 0


def test_one_particle_without_springs_is_a_body():
    body = replace(
        rope(2, 1.0),
        rest=np.zeros((1, 3)),
        mass=np.ones(1),
        springs=np.zeros((0, 2), dtype=int),
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
        ({"num_particles": 1}, "num_particles is 1; at least 2"),
        ({"num_particles": 0}, "num_particles is 0; at least 2"),
        ({"length": 0.0}, "length is 0; give a finite number above zero"),
        ({"length": -1.0}, "length is -1"),
        ({"length": NAN}, "length is nan"),
        ({"length": INF}, "length is inf"),
        ({"mass": 0.0}, "mass is 0"),
        ({"mass": -1.0}, "mass is -1"),
        ({"mass": NAN}, "mass is nan"),
        ({"stretch_stiffness": -3.0}, "stiffness is -3; give a finite number, zero or more"),
        ({"bend_stiffness": NAN}, "stiffness has a value that is not finite"),
        ({"damping": -0.1}, "damping is -0.1"),
        ({"drag": -1.0}, "drag is -1"),
        ({"drag": INF}, "drag is inf"),
        ({"friction": -0.5}, "friction is -0.5"),
        ({"friction": NAN}, "friction is nan"),
        ({"friction": INF}, "friction is inf"),
        ({"radius": -0.1}, "radius is -0.1"),
        ({"radius": INF}, "radius is inf"),
    ],
)
def test_a_rope_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        rope(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shape": (1, 5)}, "shape is 1; at least 2"),
        ({"shape": (5, 0)}, "shape is 0; at least 2"),
        ({"size": (0.0, 0.3)}, "size is 0"),
        ({"size": (0.3, -0.3)}, "size is -0.3"),
        ({"size": (0.3, INF)}, "size is inf"),
        ({"mass": -1.0}, "mass is -1"),
        ({"shear_stiffness": -3.0}, "stiffness is -3"),
        ({"stretch_stiffness": INF}, "stiffness has a value that is not finite"),
    ],
)
def test_a_cloth_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        cloth(**arguments)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"rest": np.zeros((3, 2))}, r"rest has shape \(3, 2\); \(3, 3\) is needed"),
        ({"rest": np.zeros((0, 3))}, "num_particles is 0; at least 1"),
        ({"rest": np.full((3, 3), NAN)}, "rest has a value that is not finite"),
        ({"mass": np.ones(4)}, r"mass has shape \(4,\); \(3,\) is needed"),
        ({"mass": np.array([1.0, 0.0, 1.0])}, "mass is 0; give a finite number above zero"),
        ({"mass": np.array([1.0, INF, 1.0])}, "mass has a value that is not finite"),
        ({"springs": np.zeros((3, 3), dtype=int)}, r"springs has shape \(3, 3\); \(3, 2\)"),
        ({"springs": np.array([[0, 1], [1, 2], [0, 3]])}, "springs names particle 3; a body of 3"),
        ({"springs": np.array([[0, 1], [1, 2], [0, -1]])}, "springs names particle -1"),
        ({"springs": np.array([[0, 1], [1, 2], [2, 2]])}, r"spring \[2, 2\] joins a particle to"),
        ({"springs": np.array([[0, 1], [1, 2], [1, 0]])}, r"spring \[0, 1\] is there twice"),
        ({"rest_length": np.ones(2)}, r"rest_length has shape \(2,\); \(3,\) is needed"),
        ({"rest_length": np.array([0.0, 1.0, 1.0])}, "rest_length is 0"),
        ({"stiffness": np.array([1.0, -2.0, 1.0])}, "stiffness is -2"),
        ({"damping": np.array([1.0, -2.0, 1.0])}, "damping is -2"),
        ({"faces": np.zeros((1, 2), dtype=int)}, r"faces has shape \(1, 2\); \(1, 3\)"),
        ({"faces": np.array([[0, 1, 7]])}, "faces names particle 7; a body of 3 particles"),
    ],
)
def test_a_body_refuses(arrays, message):
    with pytest.raises(ValueError, match=message):
        replace(rope(3, 1.0), **arrays)
