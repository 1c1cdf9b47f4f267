"""Garments: of the size asked for, symmetric to the bit, and refused where they are none."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import MATERIALS, Body, from_mesh, mesh_outline
from jaxsimp.bodies.garments import Garment, skirt, t_shirt, towel, trousers
from jaxsimp.bodies.meshes import face_areas
from jaxsimp.bodies.sewing import TAPER, sew
from jaxsimp.bodies.topology import (
    boundary_edges,
    boundary_loops,
    connected_pieces,
    distinct_edges,
    half_edges,
)
from jaxsimp.dynamics import at_rest, largest_time_step, make_simulation, settle

GARMENTS = [towel, t_shirt, trousers, skirt]
SEWN = [t_shirt, trousers, skirt]
lengths = st.floats(0.25, 0.7)


def two_sheets(make):
    """A garment of two sheets, with twice the particles, so that a sheet has as many."""

    def made(num_particles: int) -> Garment:
        return make(num_particles=2 * num_particles, sheets=2)

    made.__name__ = f"{make.__name__}_of_two_sheets"
    return made


@pytest.mark.parametrize("make", GARMENTS + [two_sheets(make) for make in SEWN])
@given(num_particles=st.integers(200, 400))
def test_a_garment_is_its_mirror_image(make, num_particles):
    garment = make(num_particles=num_particles)
    num_particles *= 2 if (garment.opposite != np.arange(len(garment.opposite))).any() else 1
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


@pytest.mark.parametrize("make", GARMENTS + [two_sheets(make) for make in SEWN])
def test_landmarks_have_mirror_images_and_the_right_side_is_at_higher_x(make):
    garment = make(num_particles=600)
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


def front_of(garment: Garment) -> tuple[Body, int]:
    """The front by itself, flat, of twice the fabric, and the number of its particles."""
    body = garment.body
    on_seam = garment.opposite == np.arange(body.num_particles)
    count = (body.num_particles + int(on_seam.sum())) // 2
    faces = body.faces[: len(body.faces) // 2]
    twice = body.material.scaled(mass=2.0, stiffness=2.0, damping=2.0)
    return from_mesh(body.rest[:count] * [1.0, 1.0, 0.0], faces, material=twice), count


# Widths of cuffs, hem and neck (an angle), of waist and cuffs, of waist and hem, metres.
OPENINGS = [
    (t_shirt, [0.13, 0.13, 0.34, 2 * np.hypot(0.07, 0.05)]),
    (trousers, [0.28, 0.13, 0.13]),
    (skirt, [0.26, 0.44]),
]


@pytest.mark.parametrize(("make", "widths"), OPENINGS)
@pytest.mark.parametrize("num_particles", [250, 1200])
def test_two_sheets_are_one_surface_with_openings(make, widths, num_particles):
    garment = make(num_particles=num_particles, sheets=2)
    body, openings = garment.body, len(widths)
    directed, _ = half_edges(body.faces)
    edges, _, times = distinct_edges(directed)
    assert set(times.tolist()) == {1, 2}
    # Each edge once in a direction: all triangles face the same way, in or out.
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert connected_pieces(edges, body.num_particles)[0] == 1
    # A sphere's Euler characteristic is 2, and each opening takes 1.
    assert body.num_particles - len(edges) + len(body.faces) == 2 - openings
    loops = boundary_loops(body.faces)
    assert len(loops) == openings
    assert sum(map(len, loops)) == (times == 1).sum()
    # Front and back are open at the same places, and an opening has both.
    ends = {frozenset(edge) for edge in boundary_edges(body.faces)[0].tolist()}
    assert ends == {frozenset(garment.opposite[list(edge)].tolist()) for edge in ends}
    for loop in loops:
        assert np.isin(garment.opposite[loop], loop).all()
        assert (garment.opposite[loop] == loop).sum() == 2
    around = [
        np.linalg.norm(np.diff(body.rest[[*loop, loop[0]], :2], axis=0), axis=1).sum()
        for loop in loops
    ]
    np.testing.assert_allclose(sorted(around), 2 * np.sort(widths), rtol=1e-9)
    a, b, c = body.rest[body.faces].transpose(1, 0, 2)
    up = np.cross(b - a, c - a)[:, 2]
    half = len(body.faces) // 2
    assert (up[:half] > 0).all()
    assert (up[half:] < 0).all()


@pytest.mark.parametrize("make", SEWN)
def test_two_sheets_laid_on_each_other_are_one_of_twice_the_fabric(make):
    """Masses and springs by the particle of the front at the same place, and the time step."""
    garment = make(sheets=2)
    body = garment.body
    one, count = front_of(garment)
    above = np.where(np.arange(body.num_particles) < count, np.arange(body.num_particles), -1)
    above = np.where(above < 0, garment.opposite, above)
    np.testing.assert_allclose(np.bincount(above, weights=body.mass), one.mass, rtol=1e-12)
    pairs, group, _ = distinct_edges(above[body.springs])
    np.testing.assert_array_equal(pairs, distinct_edges(one.springs)[0])
    order = np.lexsort(np.sort(one.springs, axis=1).T[::-1])
    for name in ("stiffness", "damping"):
        total = np.bincount(group, weights=getattr(body, name))
        np.testing.assert_allclose(total, getattr(one, name)[order], rtol=1e-9)
    for name in ("rest_length", "families"):
        np.testing.assert_allclose(getattr(body, name), getattr(one, name)[order][group])
    # A spring is in one sheet: neither joins front and back across the seam.
    on_seam = garment.opposite == np.arange(body.num_particles)
    side = np.where(on_seam, 0, np.where(np.arange(body.num_particles) < count, 1, -1))
    assert (side[body.springs].prod(axis=1) >= 0).all()
    # Both sheets moving alike are the one; against each other they hold still at the seam, and a
    # constraint makes no frequency higher: the stiffest mode is that of the one. Its eigenvalue is
    # found to 1e-4.
    np.testing.assert_allclose(largest_time_step(body), largest_time_step(one), rtol=2e-4)


@pytest.mark.parametrize("make", SEWN)
def test_front_and_back_lie_a_thickness_apart(make):
    garment = make(sheets=2)
    body, opposite = garment.body, garment.opposite
    thickness = body.material.thickness
    np.testing.assert_array_equal(opposite[opposite], np.arange(len(opposite)))
    np.testing.assert_array_equal(body.rest[opposite, :2], body.rest[:, :2])
    front = np.arange(body.num_particles) < front_of(garment)[1]
    on_seam = opposite == np.arange(body.num_particles)
    gap = np.where(front, 1, -1) * (body.rest[:, 2] - body.rest[opposite, 2])
    seam = body.rest[on_seam, :2]
    away = np.linalg.norm(body.rest[:, None, :2] - seam[None], axis=2).min(axis=1)
    wanted = thickness * np.minimum(1.0, away / (TAPER * thickness))
    np.testing.assert_allclose(gap, wanted, atol=1e-12)
    np.testing.assert_allclose(body.rest[on_seam, 2], thickness / 2, rtol=1e-12)
    assert body.rest[:, 2].min() == 0.0
    # The way from the seam rises by 1 in 2 TAPER, which lengthens it by 1 / (8 TAPER^2), 0.8 %.
    first, second = body.springs.T
    length = np.linalg.norm(body.rest[second] - body.rest[first], axis=1)
    assert (length / body.rest_length - 1 <= 1 / (8 * TAPER**2) + 1e-9).all()
    assert (length / body.rest_length - 1 >= -1e-9).all()
    for name, particle in garment.landmarks.items():
        if name.startswith("back_"):
            assert opposite[particle] == garment.landmarks[name.removeprefix("back_")]
            assert not front[particle]
        else:
            assert front[particle]


def test_only_openings_have_landmarks_of_their_own_at_the_back():
    def back(make):
        return {name for name in make(sheets=2).landmarks if name.startswith("back_")}

    assert back(t_shirt) == {"back_neck", "back_middle_hem"}
    assert back(trousers) == {"back_middle_waist"}
    assert back(skirt) == {"back_middle_waist", "back_middle_hem"}


@given(
    length=lengths,
    waist=st.floats(0.15, 0.3),
    hem=st.floats(0.2, 0.5),
    count=st.integers(150, 900),
)
def test_a_skirt_of_two_sheets_is_two_trapezia(length, waist, hem, count):
    body = skirt(length, waist, hem=hem, num_particles=count, sheets=2).body
    assert abs(body.num_particles - count) <= 0.1 * count
    flat = body.rest * [1.0, 1.0, 0.0]
    area = length * (waist + hem)
    np.testing.assert_allclose(face_areas(flat, body.faces).sum(), area, rtol=1e-9)
    # Half of the 0.3 kg/m2 of a garment in one sheet.
    np.testing.assert_allclose(body.mass.sum(), 0.15 * area, rtol=1e-9)


def test_sheets_are_sewn_along_edges_of_their_boundary_only():
    square = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    sheet = from_mesh(*mesh_outline(square, 60), name="bag")
    edges, _ = boundary_edges(sheet.faces)
    y = sheet.rest[:, 1]
    top = edges[(y[edges] > 0.0499).all(axis=1)]
    body, opposite = sew(sheet, top)
    assert (opposite == np.arange(body.num_particles)).sum() == len(top) + 1
    assert body.name == "bag"
    # Two squares joined at one side: a disc.
    edges = distinct_edges(half_edges(body.faces)[0])[0]
    assert body.num_particles - len(edges) + len(body.faces) == 1
    assert len(boundary_loops(body.faces)) == 1
    with pytest.raises(ValueError, match="the seam has no edge"):
        sew(sheet, top[:0])
    inside = np.setdiff1d(np.arange(sheet.num_particles), boundary_edges(sheet.faces)[0])
    edge = next(e for e in half_edges(sheet.faces)[0] if np.isin(e, inside).all())
    with pytest.raises(ValueError, match="of the seam is not on the boundary of the bag"):
        sew(sheet, edge[None])


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
        (towel, {"length": 0.0}, "length is 0 m; a body is 0.01 to 5 m large"),
        (towel, {"width": float("nan")}, "width is nan"),
        (towel, {"length": 400.0, "width": 300.0}, r"length is 400 m; .*\(millimetres\? scale="),
        (towel, {"num_particles": 2}, "num_particles is 2; give a whole number from 3"),
        (towel, {"density": -1.0}, "density is -1"),
        (skirt, {"hem": -0.2}, "hem is -0.2"),
        (skirt, {"waist": float("inf")}, "waist is inf"),
        (t_shirt, {"neck_width": 0.4}, r"neck_width is 0\.4 m; make it less than the chest, 0\.34"),
        (t_shirt, {"length": 0.15}, r"depth of the armpits is 0\.17\d+ m; .* the length, 0\.15 m"),
        (t_shirt, {"neck_depth": 0.6}, r"neck_depth is 0\.6 m; make it less than the length"),
        (t_shirt, {"slope": 60.0}, r"sleeve_width tan\(slope\) is .*make it less than sleeve"),
        (t_shirt, {"slope": 70.0}, "slope is 70.0; give a number from 0 to 60 degrees"),
        (t_shirt, {"slope": float("nan")}, "slope is nan"),
        (t_shirt, {"sleeve_length": 0.0}, "sleeve_length is 0"),
        (trousers, {"rise": 0.7}, r"rise is 0\.7 m; make it less than the length"),
        (trousers, {"cuff": 0.25}, r"cuff is 0\.25 m; make it less than half the waist and spread"),
        (trousers, {"spread": -0.2}, "cuff is .* less than half the waist and spread"),
        (t_shirt, {"sheets": 3}, "sheets is 3; give a whole number from 1 to 2"),
        (t_shirt, {"sheets": 0}, "sheets is 0"),
        (t_shirt, {"sheets": 2, "thickness": 0.0}, "thickness is 0; .* or one sheet"),
        (trousers, {"sheets": 2, "num_particles": 40}, "trousers is one edge wide from seam"),
        (skirt, {"sheets": 2, "num_particles": 4}, "two sheets of the skirt: num_points is 2"),
    ],
)  # fmt: skip
def test_a_garment_is_refused(make, dimensions, message):
    with pytest.raises(ValueError, match=message):
        make(**dimensions)
