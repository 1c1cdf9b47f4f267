"""Garments: of the size asked for, symmetric to the bit, and refused where they are none."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import MATERIALS
from jaxsimp.bodies.garments import skirt, t_shirt, towel, trousers
from jaxsimp.bodies.meshes import face_areas
from jaxsimp.dynamics import at_rest, largest_time_step, make_simulation, settle

GARMENTS = [towel, t_shirt, trousers, skirt]
lengths = st.floats(0.25, 0.7)


@pytest.mark.parametrize("make", GARMENTS)
@given(num_particles=st.integers(200, 400))
def test_a_garment_is_its_mirror_image(make, num_particles):
    garment = make(num_particles=num_particles)
    body, mirror = garment.body, garment.mirror
    assert abs(body.num_particles - num_particles) <= 0.1 * num_particles
    np.testing.assert_array_equal(body.rest[mirror], body.rest * [-1, 1, 1])
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    # Sums of a few triangles in another order.
    np.testing.assert_allclose(body.mass[mirror], body.mass, rtol=1e-12)
    springs = {
        (*sorted(pair), round(k, 9))
        for pair, k in zip(body.springs.tolist(), body.stiffness.tolist(), strict=True)
    }
    assert springs == {(*sorted(mirror[[i, j]].tolist()), k) for i, j, k in springs}


@pytest.mark.parametrize("make", GARMENTS)
def test_landmarks_have_mirror_images_and_the_right_side_is_at_higher_x(make):
    garment = make()
    rest = garment.body.rest
    for name, particle in garment.landmarks.items():
        if name.startswith("left_"):
            other = garment.landmarks[name.replace("left", "right")]
            assert garment.mirror[particle] == other
            assert rest[particle, 0] < 0 < rest[other, 0]
        elif not name.startswith("right_"):
            assert rest[particle, 0] == 0


@pytest.mark.parametrize("make", GARMENTS)
def test_usual_garments_are_light_even_and_stable_at_a_millisecond(make):
    body = make().body
    area = face_areas(body.rest, body.faces).sum()
    np.testing.assert_allclose(body.mass.sum(), MATERIALS["garment"].density * area, rtol=1e-12)
    assert largest_time_step(body) >= 1e-3
    # The shortest spring is not far below the side of an equilateral triangle of this density.
    assert body.spacing > 0.5 * np.sqrt(area / body.num_particles * 2 / np.sqrt(3))
    assert make(density=0.1).body.mass.sum() == pytest.approx(area * 0.1)
    assert make(name="mine").body.name == "mine"


@given(length=lengths, width=lengths)
def test_a_towel_is_a_rectangle(length, width):
    garment = towel(length, width, num_particles=150)
    body = garment.body
    np.testing.assert_allclose(np.ptp(body.rest, axis=0), [width, length, 0], rtol=1e-12)
    np.testing.assert_allclose(face_areas(body.rest, body.faces).sum(), width * length, rtol=1e-9)
    corner = body.rest[garment.landmarks["left_top"]]
    np.testing.assert_allclose(corner, [-width / 2, length / 2, 0], rtol=1e-12)


@given(length=lengths, waist=st.floats(0.15, 0.3), hem=st.floats(0.2, 0.5))
def test_a_skirt_is_a_trapezium(length, waist, hem):
    body = skirt(length, waist, hem=hem, num_particles=150).body
    area = face_areas(body.rest, body.faces).sum()
    np.testing.assert_allclose(area, length * (waist + hem) / 2, rtol=1e-9)


@given(
    length=st.floats(0.35, 0.7),
    chest=st.floats(0.25, 0.4),
    sleeve=st.floats(0.1, 0.25),
    slope=st.floats(0, 30),
)
def test_a_t_shirt_is_a_body_and_two_sleeves(length, chest, sleeve, slope):
    width, neck, depth = 0.11, 0.12, 0.04
    garment = t_shirt(
        length,
        chest,
        sleeve_length=sleeve,
        sleeve_width=width,
        neck_width=neck,
        neck_depth=depth,
        slope=slope,
        num_particles=200,
    )
    body, at = garment.body, {k: garment.body.rest[i] for k, i in garment.landmarks.items()}
    tan = np.tan(np.deg2rad(slope))
    # The body less what falls with the shoulders and the neck, and two sleeves: trapezia whose
    # lower side is shorter by width tan.
    drop = tan * (chest - neck) / 2
    trunk = chest * length - drop * (chest - neck) / 2 - neck * depth / 2
    sleeves = 2 * width * (sleeve - width * tan / 2)
    area = face_areas(body.rest, body.faces).sum()
    np.testing.assert_allclose(area, trunk + sleeves, rtol=1e-9)

    def apart(first, second):
        return np.linalg.norm(at[first] - at[second])

    np.testing.assert_allclose(apart("left_cuff_top", "left_cuff_bottom"), width, rtol=1e-9)
    np.testing.assert_allclose(apart("left_armpit", "right_armpit"), chest, rtol=1e-9)
    np.testing.assert_allclose(apart("left_collar", "right_collar"), neck, rtol=1e-9)
    np.testing.assert_allclose(apart("left_shoulder", "left_cuff_top"), sleeve, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(body.rest[:, 1]), length, rtol=1e-9)


@given(length=st.floats(0.4, 0.7), waist=st.floats(0.2, 0.3), spread=st.floats(0.0, 0.1))
def test_trousers_are_a_trapezium_less_the_gap_of_the_legs(length, waist, spread):
    rise, cuff = 0.15, 0.09
    garment = trousers(length, waist, rise=rise, cuff=cuff, spread=spread, num_particles=200)
    body = garment.body
    hem = waist + 2 * spread
    area = length * (waist + hem) / 2 - (hem - 2 * cuff) * (length - rise) / 2
    np.testing.assert_allclose(face_areas(body.rest, body.faces).sum(), area, rtol=1e-9)
    crotch = body.rest[garment.landmarks["crotch"]]
    np.testing.assert_allclose(crotch, [0, length / 2 - rise, 0], atol=1e-12)


def test_a_usual_t_shirt_fits_a_table():
    np.testing.assert_allclose(np.ptp(t_shirt().body.rest, axis=0), [0.6, 0.5, 0.0], atol=0.005)


@pytest.mark.parametrize("make", GARMENTS)
def test_a_garment_that_is_dropped_settles_on_the_table(make):
    body = make(num_particles=150).body
    simulation = make_simulation(body, 2e-3)
    start = goals.flat(body) + np.array([0.0, 0.0, 0.05])
    start[:, 2] += 0.2 * (body.rest[:, 0] + body.rest[:, 1] + 0.6)  # one corner first
    end = settle(simulation, at_rest(start), 1000)
    assert bool(jnp.isfinite(end.position).all())
    np.testing.assert_allclose(end.position[:, 2].min(), body.radius, atol=1e-6)
    # It falls for 0.15 s and is dragged at 3 a second: after 2 s nothing moves faster than 5 cm/s.
    assert float(jnp.abs(end.velocity).max()) < 0.05


@pytest.mark.parametrize(
    ("make", "dimensions", "message"),
    [
        (towel, {"length": 0.0}, "length is 0; give a length above zero, in metres"),
        (towel, {"width": float("nan")}, "width is nan"),
        (towel, {"length": 400.0, "width": 300.0}, "is 400 m large"),
        (towel, {"num_particles": 2}, "2 points are asked for; at least 3"),
        (towel, {"density": -1.0}, "density is -1"),
        (skirt, {"hem": -0.2}, "hem is -0.2"),
        (skirt, {"waist": float("inf")}, "waist is inf"),
        (t_shirt, {"neck_width": 0.4}, r"neck_width is 0\.4 m; it must be below the chest, 0\.34"),
        (t_shirt, {"length": 0.15}, r"depth of the armpits is 0\.17\d+ m; .* the length, 0\.15 m"),
        (t_shirt, {"neck_depth": 0.6}, r"neck_depth is 0\.6 m; it must be below the length"),
        (t_shirt, {"slope": 60.0}, r"sleeve_width tan\(slope\) is .*must be below sleeve_length"),
        (t_shirt, {"slope": 70.0}, "slope is 70; give 0 to 60 degrees"),
        (t_shirt, {"slope": float("nan")}, "slope is nan"),
        (t_shirt, {"sleeve_length": 0.0}, "sleeve_length is 0"),
        (trousers, {"rise": 0.7}, r"rise is 0\.7 m; it must be below the length"),
        (trousers, {"cuff": 0.25}, r"cuff is 0\.25 m; it must be below half the waist and spread"),
        (trousers, {"spread": -0.2}, "cuff is .* below half the waist and spread"),
    ],
)  # fmt: skip
def test_a_garment_is_refused(make, dimensions, message):
    with pytest.raises(ValueError, match=message):
        make(**dimensions)
