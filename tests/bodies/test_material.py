"""Materials: what they refuse, and that a body's arrays and its material are scaled alike."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp.bodies import MATERIALS, Material, cloth, from_mesh, rope, rope_along, towel
from jaxsimp.bodies.material import FACTORS, FAMILIES, PARAMETERS
from jaxsimp.bodies.outlines import mesh_outline

NAMES = tuple(field.name for field in fields(Material))
NAN, INF = float("nan"), float("inf")
ROUNDING = 1e-13  # of sums of up to some hundred float64 numbers, relative to them
CORNERS = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.1], [0.0, 0.1]])

factors = st.floats(0.1, 10.0)


def strip(**options):
    return from_mesh(*mesh_outline(CORNERS, 60), **options)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [-0.5, NAN, INF])
def test_a_value_that_no_material_has_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; give a number from .* to "):
        MATERIALS["cloth"].changed(**{name: value})


def test_zero_is_refused_as_a_density_only():
    for name in NAMES[1:]:
        assert getattr(MATERIALS["cloth"].changed(**{name: 0.0}), name) == 0.0
    with pytest.raises(ValueError, match=r"density is 0.0; give a number from 1e-06 to"):
        MATERIALS["cloth"].changed(density=0.0)


def test_names_that_are_no_parameters_are_refused_with_those_that_are():
    for refused in (
        lambda: MATERIALS["rope"].changed(radius=0.1),
        lambda: rope(radius=0.1),
        lambda: MATERIALS["rope"].scaled(radius=2.0),
        lambda: rope().scaled(radius=2.0),
    ):
        with pytest.raises(
            TypeError, match=r"radius is no parameter here; choose from .*thickness"
        ):
            refused()
    # Its arrays would not follow.
    with pytest.raises(TypeError, match="density is no parameter here; choose from mass"):
        rope().scaled(density=2.0)
    with pytest.raises(TypeError, match="bend_stiffness is no parameter here; choose from mass"):
        rope().scaled(bend_stiffness=2.0)


@given(values=st.fixed_dictionaries(dict.fromkeys(FACTORS, factors)))
def test_a_scaled_material_has_its_parameters_times_the_factors(values):
    material = MATERIALS["cloth"]
    scaled = material.scaled(**values)
    for name in NAMES:
        group = {"density": "mass"} | dict.fromkeys(FAMILIES, "stiffness")
        wanted = getattr(material, name) * values[group.get(name, name)]
        assert getattr(scaled, name) == wanted, name


def test_factors_on_all_springs_and_on_a_family_are_multiplied():
    scaled = MATERIALS["cloth"].scaled(stiffness=2.0, bend_stiffness=3.0)
    assert scaled == MATERIALS["cloth"].changed(
        stretch_stiffness=3.0, shear_stiffness=1.0, bend_stiffness=0.1 * 2.0 * 3.0
    )


@pytest.mark.parametrize("make", [rope, cloth, strip, lambda **options: towel(**options).body])
@given(factor=factors)
def test_a_body_of_a_scaled_material_is_the_scaled_body(make, factor):
    plain = make()
    values = dict.fromkeys(FACTORS, factor)
    scaled, made = plain.scaled(**values), make(material=plain.material.scaled(**values))
    for name in ("mass", "stiffness", "damping"):
        found, wanted = getattr(scaled, name), getattr(made, name)
        np.testing.assert_allclose(found, wanted, rtol=ROUNDING)
        np.testing.assert_allclose(found, factor * getattr(plain, name), rtol=ROUNDING)
    for name in NAMES:
        assert getattr(scaled.material, name) == getattr(made.material, name), name
    assert scaled.radius == scaled.material.thickness / 2 == factor * plain.radius


@given(stretch=factors, shear=factors, bend=factors)
def test_factors_of_single_springs_reach_the_material_by_their_family(stretch, shear, bend):
    body = cloth((4, 3))
    each = np.array([stretch, shear, bend])[body.families]
    found = body.scaled(stiffness=each)
    np.testing.assert_array_equal(found.stiffness, each * body.stiffness)
    again = cloth((4, 3), material=found.material)
    np.testing.assert_allclose(again.stiffness, found.stiffness, rtol=ROUNDING)
    assert found.material.density == body.material.density


def test_springs_that_differ_from_their_family_leave_the_material_its_median():
    body = cloth((4, 4))
    each = np.ones(len(body.springs))
    each[:2] = [100.0, 0.0]
    found = body.scaled(stiffness=each)
    assert found.material == body.material
    np.testing.assert_array_equal(found.stiffness[:3], [150.0, 0.0, 1.5])


def test_a_rope_without_bend_springs_keeps_its_material_in_step():
    found = rope(2).scaled(stiffness=2.0).material
    assert found.bend_stiffness == 6.0
    lone = replace(
        rope(2),
        springs=np.zeros((0, 2), dtype=int),
        **{name: np.zeros(0) for name in ("rest_length", "stiffness", "damping")},
        families=np.zeros(0, dtype=int),
    )
    assert lone.scaled(stiffness=2.0).material.stretch_stiffness == 300.0


@pytest.mark.parametrize("make", [rope, cloth, strip], ids=["rope", "cloth", "mesh"])
def test_springs_have_the_stiffness_of_their_family(make):
    plain = make()
    for family, name in enumerate(FAMILIES):
        own = plain.families == family
        if own.any():
            double = make(**{name: 2 * getattr(plain.material, name)})
            np.testing.assert_array_equal(double.stiffness[own], 2 * plain.stiffness[own])
            np.testing.assert_array_equal(double.stiffness[~own], plain.stiffness[~own])


# --- density and mass ----------------------------------------------------------------------------


@given(length=st.floats(0.05, 1.2), density=st.floats(0.01, 1.0))
def test_the_mass_of_a_rope_is_its_density_times_its_length(length, density):
    zigzag = np.zeros((5, 3))
    zigzag[:, 0], zigzag[1::2, 1] = np.arange(5) * length, length
    for body, extent in (
        (rope(9, length, density=density), length),
        (rope_along(zigzag, density=density), 4 * np.sqrt(2) * length),
    ):
        np.testing.assert_allclose(body.mass.sum(), density * extent, rtol=ROUNDING)
        assert body.material.density == density


@given(size=st.tuples(st.floats(0.05, 2.0), st.floats(0.05, 2.0)))
def test_the_mass_of_a_cloth_of_a_material_is_its_density_times_its_area(size):
    body = cloth((3, 4), size, material=MATERIALS["cloth"])
    np.testing.assert_allclose(
        body.mass.sum(), MATERIALS["cloth"].density * size[0] * size[1], rtol=ROUNDING
    )


@pytest.mark.parametrize(
    ("make", "extent"),
    [(lambda **o: rope(9, 2.0, **o), 2.0), (lambda **o: cloth((3, 4), (2.0, 0.5), **o), 1.0)],
)
def test_a_mass_makes_the_density(make, extent):
    assert make().mass.sum() == pytest.approx(0.02, rel=ROUNDING)  # whatever the size
    assert make(drag=9.0).mass.sum() == pytest.approx(0.02, rel=ROUNDING)
    assert make().material.density == pytest.approx(0.02 / extent, rel=ROUNDING)
    given = make(mass=0.3, material=MATERIALS["cloth"].changed(shear_stiffness=0.0))
    assert given.mass.sum() == pytest.approx(0.3, rel=ROUNDING)
    assert given.material.density == pytest.approx(0.3 / extent, rel=ROUNDING)


@pytest.mark.parametrize("make", [rope, cloth])
def test_a_mass_and_a_density_at_once_are_refused(make):
    with pytest.raises(ValueError, match=r"mass is 0.3 and density is 0.1; give one of them"):
        make(mass=0.3, density=0.1)


@pytest.mark.parametrize("kind", ["rope", "cloth"])
def test_the_default_material_is_that_of_the_default_body(kind):
    found = {"rope": rope, "cloth": cloth}[kind]().material
    assert found.density == pytest.approx(MATERIALS[kind].density, rel=ROUNDING)
    assert found.changed(density=1.0) == MATERIALS[kind].changed(density=1.0)


def test_shear_is_refused_where_there_are_no_such_springs():
    for make, name in ((rope, "rope"), (strip, "mesh")):
        with pytest.raises(ValueError, match=f"shear_stiffness is 0.5; a {name} has no shear"):
            make(material=MATERIALS["cloth"])


def test_what_is_fitted_can_be_scaled():
    assert set(PARAMETERS) < set(FACTORS)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_number_of_low_precision_is_taken_as_a_float():
    given = MATERIALS["rope"].changed(density=np.float16(0.1))
    assert type(given.density) is float
    body = rope(5, 0.3, material=given)
    # Exact but for rounding of float64; float16 has 11 bits.
    np.testing.assert_allclose(body.mass.sum(), float(np.float16(0.1)) * 0.3, rtol=1e-14)
