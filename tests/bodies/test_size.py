"""One rule of size for every body, and numbers that no body has, refused where they are given."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from jaxsimp.bodies import (
    MATERIALS,
    cloth,
    from_mesh,
    mesh_outline,
    remesh,
    rope,
    rope_along,
    t_shirt,
    towel,
)
from jaxsimp.bodies.sewing import sew
from jaxsimp.bodies.size import LARGEST, SMALLEST, require_size, unit_of

ROPE, CLOTH = rope(5), cloth((4, 4))
CORNERS = np.array([[0, 0], [0.3, 0], [0.3, 0.3], [0, 0.3]])
MAKERS = {
    "rope": lambda scale: rope(5, 0.3 * scale),
    "rope_along": lambda scale: rope_along(0.6 * scale * ROPE.rest),
    "cloth": lambda scale: cloth((4, 4), (0.3 * scale, 0.2 * scale)),
    "from_mesh": lambda scale: from_mesh(scale * CLOTH.rest, CLOTH.faces),
    "scale of from_mesh": lambda scale: from_mesh(CLOTH.rest, CLOTH.faces, scale=scale),
    "mesh_outline": lambda scale: mesh_outline(scale * CORNERS, 16),
    "remesh": lambda scale: remesh(scale * CLOTH.rest, CLOTH.faces, 16),
    "towel": lambda scale: towel(0.3 * scale, 0.2 * scale, num_particles=30),
    "Body": lambda scale: replace(CLOTH, rest=scale * CLOTH.rest),
}


@pytest.mark.parametrize("make", MAKERS)
def test_every_body_has_the_same_limits_of_size(make):
    for size in (1.001 * SMALLEST, 0.3, 0.999 * LARGEST):
        if make != "towel" or size > 0.1:  # with so many triangles
            MAKERS[make](size / 0.3)
    for size in (0.999 * SMALLEST, 1.001 * LARGEST):
        with pytest.raises(ValueError, match=r"is [\d.]+ m; a body is 0\.01 to 5 m large. Give m"):
            MAKERS[make](size / 0.3)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(("scale", "unit"), [(1e3, "millimetres"), (100.0, "centimetres")])
def test_a_body_in_another_unit_is_told_its_factor(make, scale, unit):
    with pytest.raises(ValueError, match=rf"{unit}\? scale={1 / scale:g}, or multiply by"):
        MAKERS[make](scale)


def test_the_guess_is_the_unit_of_a_usual_body():
    assert unit_of(7.0).startswith("inches?")
    assert unit_of(3e-4).startswith("converted from millimetres twice? scale=1000")
    assert unit_of(1e9) == "scale is the metres in one unit"


@pytest.mark.parametrize("extent", [None, 1j, "1", [1.0], float("nan"), True])
def test_an_extent_is_a_number(extent):
    with pytest.raises(ValueError, match=r"length is .*; give a number from 0\.01 to 5 m"):
        require_size("length", extent)


# --- counts and masses ---------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rope(10**9), "num_particles is 1000000000; give a whole number from 2 to 250000"),
        (lambda: rope(5.0), "num_particles is 5.0"),
        (lambda: rope(True), "num_particles is True"),
        (lambda: cloth((5000, 5000)), "rows times columns, is 25000000; give a .* to 250000"),
        (lambda: cloth((5, 5, 5)), r"shape is \(5, 5, 5\); give two numbers"),
        (lambda: cloth(5), "shape is 5; give two numbers, along x and along y"),
        (lambda: cloth((5, 5), 0.3), "size is 0.3; give two numbers"),
        (lambda: towel(num_particles=10**9), "num_particles is 1000000000; give"),
        (lambda: t_shirt(num_particles=2.5), "num_particles is 2.5; give a whole number"),
        (lambda: t_shirt(sheets=True), "sheets is True; give a whole number from 1 to 2"),
        (lambda: t_shirt(chest=-0.3), "chest is -0.3 m; a body is"),
        (lambda: t_shirt(slope=1j), "slope is 1j; give a number from 0 to 60 degrees"),
        (lambda: mesh_outline(CORNERS, 10**9), "num_points is 1000000000; give"),
        (lambda: mesh_outline("abcd", 20), "corners is 'abcd'; give rows of 2 real numbers"),
        (lambda: cloth(mass=1j), "mass is 1j; give a number from 1e-06 to 1000 kg"),
        (lambda: cloth(mass=1e-300), "mass is 1e-300; give a number from 1e-06 to 1000 kg"),
        (lambda: cloth(mass=[1.0, 2.0]), r"mass is \[1.0, 2.0\]; give a number"),
        (lambda: cloth(drag=1e300), "drag is 1e[+]300; give a number from 0 to 1e[+]06 /s"),
        (lambda: cloth(density=np.ones(3)), "density is an array of float64, shape .3,.; give"),
        (lambda: rope(damping=True), "damping is True; give a number from 0"),
        (lambda: rope(material="rope"), r"material is 'rope'; give .* jaxsimp.MATERIALS\['rope'\]"),
        (lambda: MATERIALS["rope"].scaled(drag="2"), "the factor of drag is '2'; give a number"),
        (lambda: ROPE.scaled(mass=[1.0, 2.0]), r"the factor of mass is \[1.0, 2.0\]; give"),
        (lambda: ROPE.scaled(stiffness=np.ones(3)), r"stiffness has shape \(3,\); give one factor"),
        (lambda: ROPE.scaled(stiffness=b"1"), "stiffness is b'1'; give an array of numbers"),
        (lambda: cloth(np.array(0.5)), r"shape is array\(0.5\); give two numbers"),
        (lambda: replace(ROPE, name=np.nan), "name is nan; give a text, such as"),
        (lambda: from_mesh(CLOTH.rest, 1.0 * CLOTH.faces), "faces is an array of float64, shape"),
        (
            lambda: from_mesh(CLOTH.rest > 0, CLOTH.faces),
            "points is an array of bool, .*; give real numbers, a row",
        ),
        (lambda: from_mesh(CLOTH.rest[:0], CLOTH.faces), "a triangle names .*, and there are no"),
        (lambda: from_mesh(CLOTH.rest, CLOTH.faces, scale=1j), "scale is 1j; give a number"),
        (lambda: rope_along(ROPE.rest[:, :2]), r"points is an array of shape \(5, 2\); give rows"),
        (lambda: replace(ROPE, faces=np.zeros((0, 3))), "faces is an array of float64, shape"),
        (lambda: replace(ROPE, mass="heavy"), "mass holds no real numbers; give an array in kg"),
        (lambda: replace(ROPE, mass=2.0), r"mass has shape \(\); give shape \(5,\), for 5"),
        (
            lambda: replace(ROPE, rest=ROPE.rest + 1e300),
            r"rest\[0, 0\] is .*from -50 to 50 m|0 m; a b",
        ),
        (lambda: replace(ROPE, material=None), "material is None; give a jaxsimp.Material"),
        (lambda: sew(CLOTH, np.array([[0.0, 1.0]])), "seam is an array of float64, shape"),
        (lambda: sew(CLOTH, np.array([[0, 99]])), "seam names 99; the ids of 16 particles are 0"),
    ],
)
def test_what_is_no_number_of_a_body_is_refused_where_it_is_given(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.usefixtures("unchecked_shapes")
def test_arrays_of_other_types_and_orders_make_the_same_body():
    given = CLOTH.rest.astype(np.float32)
    exact = from_mesh(given.astype(float), CLOTH.faces)
    for points, faces in (
        (np.asfortranarray(given), CLOTH.faces.astype(np.uint8)),
        (given.tolist(), CLOTH.faces.tolist()),
    ):
        found = from_mesh(points, faces)
        np.testing.assert_array_equal(found.rest, exact.rest)
        np.testing.assert_array_equal(found.faces, exact.faces)
    halves = replace(CLOTH, mass=CLOTH.mass.astype(np.float16), springs=CLOTH.springs.tolist())
    assert (halves.mass.dtype, halves.springs.dtype) == (np.float64, np.int64)


def test_a_body_has_its_own_arrays_read_only_also_after_unpickling():
    mass = np.full(5, 0.01)
    body = replace(ROPE, mass=mass)
    mass[0] = 1.0  # the caller's array is still the caller's
    assert body.mass[0] == 0.01
    for each in (body, pickle.loads(pickle.dumps(body))):
        with pytest.raises(ValueError, match="read-only"):
            each.mass[0] = 1.0
