"""Folds: isometries and layers, against what paper does."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from jaxsimp import goals
from jaxsimp.bodies import Body, cloth, rope
from jaxsimp.bodies.garments import skirt, t_shirt, towel, trousers
from jaxsimp.dynamics.contact.settings import make_self_contact

# Float64 coordinates of about 1 m, a few operations each.
ROUNDING = 1e-12

angles = st.floats(-7.0, 7.0)
coordinates = st.floats(-0.2, 0.2)
CLOTH = cloth((6, 5), (0.3, 0.2))


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


# Lines near the middle, so that what is turned over covers something.
middles = st.floats(-0.04, 0.04)


@given(point=st.tuples(middles, middles), angle=angles, scale=st.floats(0.01, 100.0))
def test_fold_mirrors_the_left_on_the_right(point, angle, scale):
    start = goals.flat(CLOTH)
    direction = scale * np.array([np.cos(angle), np.sin(angle)])
    folded = goals.fold(CLOTH, start, np.array(point), direction)
    # In the complex plane with the line as real axis: above it is left, and conjugates.
    unit = np.exp(1j * angle)
    away = (start[:, :2] @ np.array([1, 1j]) - complex(*point)) / unit
    # What is nearer to the line than this may be taken for its crease (documented: rounding).
    assume(np.abs(away.imag).min() > 1e-6)
    left = away.imag > 0
    wanted = np.where(left, away.conj(), away) * unit + complex(*point)
    np.testing.assert_allclose(folded[:, :2] @ np.array([1, 1j]), wanted, atol=ROUNDING)
    np.testing.assert_allclose(folded[:, 2], CLOTH.radius * np.where(left, 3, 1), rtol=ROUNDING)
    for side in (left, ~left):
        np.testing.assert_allclose(distances(folded[side]), distances(start[side]), atol=ROUNDING)


@given(angle=angles)
def test_fold_along_a_row_of_particles_makes_a_crease_between_the_layers(angle):
    body = cloth((5, 4), (0.2, 0.3))
    row = body.rest[:, 0]
    start = goals.flat(body, angle)
    # The middle row lies along y; turned, its direction is this, and its left is -x.
    folded = goals.fold(body, start, np.zeros(2), np.array([-np.sin(angle), np.cos(angle)]))
    layers = body.radius * np.select([row < -1e-9, row > 1e-9], [3.0, 1.0], 2.0)
    np.testing.assert_allclose(folded[:, 2], layers, rtol=ROUNDING)
    moved = goals.flat(body, angle).reshape(5, 4, 3)[[4, 3, 2, 3, 4], :, :2]
    np.testing.assert_allclose(folded.reshape(5, 4, 3)[..., :2], moved, atol=ROUNDING)


def test_a_fold_leaves_what_it_is_given_alone():
    start = goals.flat(CLOTH)
    goals.fold(CLOTH, start, np.zeros(2), np.array([1.0, 0.0]))
    np.testing.assert_array_equal(start, goals.flat(CLOTH))


def test_folding_twice_stacks_four_layers_a_thickness_apart():
    body = cloth((4, 4))
    half = goals.fold(body, goals.flat(body), np.zeros(2), np.array([0.0, 1.0]))
    quarter = goals.fold(body, half, np.zeros(2), np.array([1.0, 0.0]))
    stacks: dict[tuple[float, ...], list[float]] = {}
    for *xy, z in quarter.round(9).tolist():
        stacks.setdefault(tuple(xy), []).append(z / body.radius)
    assert len(stacks) == 4
    for heights in stacks.values():
        np.testing.assert_allclose(sorted(heights), [1.0, 3.0, 5.0, 7.0], rtol=1e-6)
    # The order of the layers, as paper does it: the second fold turns its half upside down.
    z = quarter.reshape(4, 4, 3)[..., 2] / body.radius
    np.testing.assert_allclose(z[3, 0], 1.0)  # right of both lines: stays
    np.testing.assert_allclose(z[0, 0], 3.0)  # folded first
    np.testing.assert_allclose(z[0, 3], 5.0)  # folded first, then turned over
    np.testing.assert_allclose(z[3, 3], 7.0)  # at the bottom of what was turned over


@pytest.mark.parametrize(
    ("point", "direction", "message"),
    [
        ([0.0, 0.0], [0.0, 0.0], r"direction is \[0.0, 0.0\]; give a finite vector with a length"),
        ([0.0, 0.0], [np.nan, 1.0], "direction is"),
        ([0.0, 0.0], [np.inf, 1.0], "direction is"),
        ([np.nan, 0.0], [1.0, 0.0], r"point is \[nan, 0.0\]; give finite coordinates"),
    ],
)
def test_fold_refuses(point, direction, message):
    with pytest.raises(ValueError, match=message):
        goals.fold(CLOTH, goals.flat(CLOTH), np.array(point), np.array(direction))


# --- parts, and back again -----------------------------------------------------------------------


@given(point=st.tuples(middles, middles), angle=angles)
def test_a_fold_and_a_fold_back_change_nothing(point, angle):
    direction = np.array([np.cos(angle), np.sin(angle)])
    start = goals.flat(CLOTH)
    distance = (start[:, :2] - np.array(point)) @ np.array([-direction[1], direction[0]])
    assume(np.abs(distance).min() > 1e-6)  # no particle on the crease, which stays raised
    once = goals.fold(CLOTH, start, np.array(point), direction)
    twice = goals.fold(CLOTH, once, np.array(point), -direction, part=distance > 0)
    np.testing.assert_allclose(twice, start, atol=ROUNDING)


@given(seed=st.integers(0, 10**6))
def test_only_the_part_is_turned_over(seed):
    part = np.random.default_rng(seed).random(30) < 0.5
    start = goals.flat(CLOTH)
    line = np.array([0.01, 0.0]), np.array([0.0, 1.0])
    whole, found = (goals.fold(CLOTH, start, *line, part=p) for p in (None, part))
    np.testing.assert_array_equal(found[~part], start[~part])
    np.testing.assert_array_equal(found[part, :2], whole[part, :2])


def test_a_fold_of_nothing_changes_nothing():
    start = goals.flat(CLOTH)
    left_of_all = np.array([-1.0, 0.0]), np.array([0.0, 1.0])
    np.testing.assert_array_equal(goals.fold(CLOTH, start, *left_of_all), start)
    none = np.zeros(30, dtype=bool)
    np.testing.assert_array_equal(
        goals.fold(CLOTH, start, np.zeros(2), np.array([0.0, 1.0]), part=none), start
    )


def test_a_part_that_covers_nothing_lies_on_the_table():
    start = goals.flat(CLOTH)
    away = goals.fold(CLOTH, start, np.array([0.15, 0.0]), np.array([0.0, 1.0]))
    # About its own edge, a cloth comes to lie beside itself.
    inner = start[:, 0] < 0.149
    np.testing.assert_allclose(away[inner, 0], 0.3 - start[inner, 0], atol=ROUNDING)
    np.testing.assert_allclose(away[inner, 2], CLOTH.radius, rtol=1e-9)


def test_a_rope_is_folded_on_itself():
    body = rope(10, 0.45)
    found = goals.fold(body, goals.flat(body), np.zeros(2), np.array([0.0, 1.0]))
    np.testing.assert_allclose(found[:5, 0], found[:4:-1, 0], atol=ROUNDING)
    np.testing.assert_allclose(found[:, 2], body.radius * np.repeat([3.0, 1.0], 5), rtol=1e-9)


# --- named folds ---------------------------------------------------------------------------------


def edge_stretch(body: Body, found: np.ndarray) -> np.ndarray:
    """How far each stretch spring is from its rest length, metres."""
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    length, rest = (
        np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
        for points in (found, body.rest)
    )
    return length - rest


def stacks(found: np.ndarray, body: Body) -> dict[tuple[float, float], list[float]]:
    """Heights in radii of the particles at each place on the table."""
    places: dict[tuple[float, float], list[float]] = {}
    for x, y, z in found.tolist():
        at = (round(x, 9) + 0.0, round(y, 9) + 0.0)
        places.setdefault(at, []).append(z / body.radius)
    return {at: sorted(heights) for at, heights in places.items()}


# The lines of the first two lie between rows of particles; those of the last lie on rows.
@pytest.mark.parametrize(
    ("name", "shape", "layers", "extent"),
    [
        ("side", (12, 10), [1, 3], (0.3 * 5 / 11, 0.3)),
        ("quarter", (12, 10), [1, 3, 5, 7], (0.3 * 5 / 11, 0.3 * 4 / 9)),
        ("letter", (10, 10), [1, 3, 5], (0.1, 0.3)),
    ],
)
def test_named_folds_stack_their_layers(name, shape, layers, extent):
    body = cloth(shape, (0.3, 0.3))
    found = goals.fold_sequence(body, goals.rectangle_folds(body, name))
    inner = {
        at: z for at, z in stacks(found, body).items() if name != "letter" or abs(at[0]) < 0.049
    }
    assert len(inner) == {"side": 60, "quarter": 30, "letter": 20}[name]
    for heights in inner.values():
        np.testing.assert_allclose(heights, layers, rtol=1e-9)
    np.testing.assert_allclose(np.ptp(found[:, :2], axis=0), extent, rtol=1e-9)
    goals.check_goal(body, found)


@given(
    name=st.sampled_from(["side", "diagonal", "quarter", "letter", "four_corners"]),
    rows=st.integers(4, 12),
)
def test_named_folds_are_isometries_but_for_creases_and_layers(name, rows):
    body = cloth((rows, rows), (0.3, 0.3))
    folds = goals.rectangle_folds(body, name)
    found = goals.fold_sequence(body, folds)
    stretch = edge_stretch(body, found)
    # No edge is longer than it was, but for the height of the layers that it joins.
    assert stretch.max() <= np.ptp(found[:, 2])
    whole = np.ones(len(body.faces), dtype=bool)
    for fold in folds:  # triangles on one side of every line
        normal = np.array([-fold.direction[1], fold.direction[0]])
        side = (body.rest[:, :2] - fold.point) @ normal > 1e-9
        whole &= (side[body.faces].sum(axis=1) % 3) == 0
    kept = np.tile(whole, 3)
    z = found[body.faces][:, :, 2]
    flat = np.tile(np.ptp(z, axis=1) < 1e-9, 3)
    np.testing.assert_allclose(stretch[kept & flat], 0.0, atol=ROUNDING)


@given(rows=st.integers(3, 6), side=st.floats(0.1, 0.6))
def test_four_corners_meet_at_the_centre(rows, side):
    body = cloth((2 * rows + 1, 2 * rows + 1), (side, side))
    found = goals.fold_sequence(body, goals.rectangle_folds(body, "four_corners"))
    corners = np.abs(body.rest[:, :2]).min(axis=1) > side / 2 - 1e-9
    assert corners.sum() == 4
    np.testing.assert_allclose(found[corners, :2], 0.0, atol=ROUNDING)
    # Four corners side by side: two layers everywhere, and a square turned by 45 degrees.
    np.testing.assert_allclose(found[corners, 2], 3 * body.radius, rtol=1e-9)
    assert np.abs(found[:, 0]).max() == pytest.approx(side / 2)
    assert (np.abs(found[:, :2]).sum(axis=1) <= side / 2 + 1e-9).all()


@given(length=st.floats(0.2, 0.6), width=st.floats(0.2, 0.6))
def test_the_diagonal_fold_keeps_the_diagonal(length, width):
    body = cloth((7, 7), (length, width))
    found = goals.fold_sequence(body, goals.rectangle_folds(body, "diagonal"))
    grid = found.reshape(7, 7, 3)
    rest = body.rest.reshape(7, 7, 3)
    for i in range(7):
        np.testing.assert_allclose(grid[i, 6 - i, :2], rest[i, 6 - i, :2], atol=ROUNDING)
    np.testing.assert_array_equal(grid[6, 6], rest[6, 6] + [0, 0, body.radius])
    assert grid[0, 0] @ [width, length, 0] > 0  # the other corner came over


def test_a_sequence_goes_on_from_given_positions():
    body = cloth((6, 6))
    first, second = goals.rectangle_folds(body, "quarter")
    half = goals.fold_sequence(body, [first])
    np.testing.assert_array_equal(
        goals.fold_sequence(body, [second], half), goals.fold_sequence(body, [first, second])
    )
    np.testing.assert_array_equal(goals.fold_sequence(body, []), goals.flat(body))


def test_named_folds_refuse():
    with pytest.raises(ValueError, match=r"fold is 'book'; choose from side, diagonal"):
        goals.rectangle_folds(CLOTH, "book")
    with pytest.raises(
        ValueError, match=r"cloth is 0\.3 m by 0\.2 m; only the corners of a square"
    ):
        goals.rectangle_folds(CLOTH, "four_corners")


# --- garments ------------------------------------------------------------------------------------


@given(num_particles=st.integers(200, 400), slope=st.floats(0, 30))
def test_sleeves_are_turned_in_about_the_sides_of_the_shirt(num_particles, slope):
    shirt = t_shirt(slope=slope, num_particles=num_particles)
    body = shirt.body
    found = goals.fold_sequence(body, goals.sleeves_in(shirt))
    x = body.rest[:, 0]
    half = abs(x[shirt.landmarks["left_armpit"]])
    sleeves = np.abs(x) > half + 1e-9
    wanted = np.where(sleeves, np.sign(x) * (2 * half - np.abs(x)), x)
    np.testing.assert_allclose(found[:, 0], wanted, atol=ROUNDING)
    np.testing.assert_allclose(found[:, 1], body.rest[:, 1], atol=ROUNDING)
    # Both sleeves lie on the shirt alone, so that the folded shirt is its own mirror image.
    np.testing.assert_allclose(found[sleeves, 2], 3 * body.radius, rtol=1e-9)
    np.testing.assert_allclose(found[shirt.mirror], found * [-1, 1, 1], atol=ROUNDING)
    goals.check_goal(body, found)


@given(num_particles=st.integers(200, 400), spread=st.floats(0, 0.1))
def test_a_leg_lies_on_the_other(num_particles, spread):
    garment = trousers(spread=spread, num_particles=num_particles)
    body = garment.body
    found = goals.fold_sequence(body, goals.leg_over_leg(garment))
    np.testing.assert_allclose(found[garment.mirror, :2], found[:, :2], atol=ROUNDING)
    heights = body.radius * (2 - np.sign(body.rest[:, 0]))
    np.testing.assert_allclose(found[:, 2], heights, rtol=1e-9)
    goals.check_goal(body, found)


def test_a_towel_takes_the_folds_of_a_rectangle():
    body = towel(num_particles=200).body
    for name in ("side", "diagonal", "quarter", "letter"):
        goals.check_goal(body, goals.fold_sequence(body, goals.rectangle_folds(body, name)))


@pytest.mark.parametrize(
    ("folds", "lacks"), [(goals.sleeves_in, "left_armpit"), (goals.leg_over_leg, "crotch")]
)
def test_a_garment_without_the_parts_is_refused(folds, lacks):
    with pytest.raises(
        ValueError, match=f"the skirt has no {lacks}; it has middle_waist, right_waist"
    ):
        folds(skirt(num_particles=100))


# --- what lies in layers -------------------------------------------------------------------------


def touching(body: Body, positions: np.ndarray) -> np.ndarray:
    """Pairs of particles at about one place that are not adjacent along the body."""
    reach = 0.5 * np.median(body.rest_length[body.families == 0])
    pairs = cKDTree(positions[:, :2]).query_pairs(reach, output_type="ndarray")
    return pairs[make_self_contact(body, 1e-4).may_touch[tuple(pairs.T)]]


@pytest.mark.parametrize("make", [t_shirt, trousers])
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_front_and_back_are_folded_together(make, times, angle):
    """All layers of one side come to lie on the other, in reversed order, a thickness apart."""
    body = make(num_particles=400, sheets=2).body
    before = goals.flat(body)
    middle = np.array([0.0, np.ptp(before[:, 1]) * -0.02])
    for turn in range(times):
        direction = np.array([np.cos(angle + turn * np.pi / 2), np.sin(angle + turn * np.pi / 2)])
        after = goals.fold(body, before, middle, direction)
        left = (before[:, :2] - middle) @ np.array([-direction[1], direction[0]]) > 0
        first, second = touching(body, before).T
        both = left[first] & left[second]
        rose = (before[:, 2][first] - before[:, 2][second])[both]
        np.testing.assert_allclose(
            (after[:, 2][first] - after[:, 2][second])[both], -rose, atol=ROUNDING
        )
        pairs = touching(body, after)
        apart = np.abs(np.subtract(*after[pairs, 2].T))
        assert apart.min() > 0.99 * body.material.thickness
        moved, still = pairs[left[pairs[:, 0]] != left[pairs[:, 1]]].T
        upper = np.where(left[moved], moved, still)
        lower = np.where(left[moved], still, moved)
        assert (after[upper, 2] > after[lower, 2]).all()
        before = after
    layers = 2 * 2**times
    assert np.ptp(after[:, 2]) <= (layers - 1 + 1e-9) * body.material.thickness


def test_edges_of_layers_keep_their_lengths_but_across_creases():
    body = t_shirt(num_particles=400, sheets=2).body
    folded = goals.fold(body, goals.flat(body), np.zeros(2), np.array([1.0, 0.0]))
    first, second = body.springs[body.families == 0].T
    length = np.linalg.norm(folded[second] - folded[first], axis=1)
    crosses = body.rest[first, 1] * body.rest[second, 1] <= 0
    # Where the front rises from the seam, by half a thickness in a row: 1 %.
    ratio = length / body.rest_length[body.families == 0]
    assert np.abs(ratio[~crosses] - 1).max() < 0.02
