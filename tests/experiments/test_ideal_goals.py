from functools import cache

import numpy as np
import pytest

from experiments.ideal_goals import (
    FOLDS,
    LINES,
    NOISES,
    IdealGoal,
    add_noise,
    ideal_goal,
    ideal_line,
    is_right,
    rounded_fold,
)
from experiments.settled_goals import SETTLED_FOLDS, settled_goal
from jaxsimp import bodies, goals
from jaxsimp.simplification import KeyPoints

ROUNDING = 1e-12  # metres


@cache
def cloth(rows=16, columns=16):
    return bodies.cloth((rows, columns), (0.3, 0.3 * columns / rows))


def key_points(particles, count):
    particles = np.sort(np.array(particles, dtype=int))
    return KeyPoints(
        particles=particles,
        positions=np.zeros((len(particles), 3)),
        elements=np.zeros((0, 3), dtype=int),
        num_particles=count,
        method="by hand",
        sizes=(len(particles),),
        errors=(0.0,),
        tolerance=1.0,
        max_error=0.0,
        rms_error=0.0,
    )


def nearest(ideal):
    """Particles nearest to the true points."""
    away = np.linalg.norm(ideal.body.rest[:, None] - ideal.true_points, axis=2)
    return away.argmin(axis=0)


@pytest.mark.parametrize(
    ("name", "point", "direction"),
    [("side, x", (0, 0), (0, 1)), ("side, off centre", (-0.045, 0), (0, 1))],
)
def test_a_sharp_fold_is_that_of_goals(name, point, direction):
    sheet = cloth()
    expected = goals.fold(
        sheet, goals.flat(sheet), np.array(point, float), np.array(direction, float)
    )
    ideal = ideal_goal(sheet, name, gap=0.004)
    assert np.allclose(ideal.goal, expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("name", FOLDS)
@pytest.mark.parametrize("shape", [(16, 16), (16, 24)])
def test_true_points_are_the_corners_of_an_isometry(name, shape):
    """Between folds lengths are kept: no spring away from every crease is stretched."""
    ideal = ideal_goal(cloth(*shape), name, gap=0.0)
    springs = ideal.body.springs
    length = np.linalg.norm(ideal.goal[springs[:, 1]] - ideal.goal[springs[:, 0]], axis=1)
    ratio = length / ideal.body.rest_length
    assert ratio.max() <= 1 + 1e-9  # a fold shortens what crosses it
    assert (ratio < 1 - 1e-9).any() == (name != "flat")
    assert np.mean(np.abs(ratio - 1) < 1e-9) > 0.6


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("flat", 4),
        ("side, x", 6),
        ("side, y", 6),
        ("diagonal", 4),
        ("other diagonal", 4),
        ("letter", 8),
        ("quarter", 9),
        ("four corners", 8),
        ("side, off centre", 6),
        ("corner", 6),
        ("diagonal, off centre", 6),
        ("through a corner", 5),
    ],
)
def test_folds_have_as_many_points_as_by_hand(name, count):
    assert len(ideal_goal(cloth(), name).true_points) == count


@pytest.mark.parametrize("name", FOLDS)
def test_every_true_point_is_on_the_outline_but_the_middle_of_the_quarter(name):
    ideal = ideal_goal(cloth(16, 24), name)
    relative = np.abs(ideal.true_points[:, :2] / [0.15, 0.225])
    inside = relative.max(axis=1) < 1 - 1e-9
    assert inside.sum() == (name == "quarter")
    assert relative.max() <= 1 + 1e-9


def test_a_rounded_crease_is_half_an_ellipse_and_the_rest_a_sharp_fold():
    sheet = cloth(61, 5)
    point, direction = np.zeros(2), np.array([0.0, 1.0])
    sharp, rounded = (
        rounded_fold(sheet.rest, point, direction, 0.01, radius) for radius in (0.0, 0.02)
    )
    away = np.abs(sheet.rest[:, 0]) >= np.pi * 0.01
    assert np.allclose(sharp[away], rounded[away], rtol=0, atol=ROUNDING)
    crease = rounded[~away]
    assert len(crease) >= 5 * 10
    centre = np.array([np.pi * 0.01, 0.01])
    offset = (crease[:, [0, 2]] - centre) / [0.02, 0.01]
    assert np.allclose(np.sum(offset**2, axis=1), 1, rtol=0, atol=1e-9)
    assert (offset[:, 0] <= 0).all()  # it bulges away from what lies on each other


@pytest.mark.parametrize(
    ("name", "count", "heights"), [("letter", 17, [0, 1, 2]), ("quarter", 16, [0, 1, 2, 3])]
)  # no particle lies on a crease
def test_layers_are_a_gap_apart(name, count, heights):
    ideal = ideal_goal(cloth(count, count), name, gap=0.01)
    levels = (ideal.goal[:, 2] - 0.005) / 0.01
    assert np.unique(levels.round(9)).tolist() == heights


@pytest.mark.parametrize("kind", NOISES)
def test_noise_has_its_level_and_its_seed(kind):
    ideal = ideal_goal(cloth(40, 40), "side, x")
    first, second, other = (add_noise(ideal, kind, 0.002, seed) for seed in (1, 1, 2))
    assert np.array_equal(first.goal, second.goal)
    assert not np.array_equal(first.goal, other.goal)
    assert np.array_equal(first.true_points, ideal.true_points)
    noise = first.goal - ideal.goal
    axes = {"in plane": [0, 1], "out of plane": [2], "wrinkles": [2]}.get(kind, [0, 1, 2])
    quiet = [axis for axis in range(3) if axis not in axes]
    assert not noise[:, quiet].any()
    if kind == "outliers":
        far = np.linalg.norm(noise, axis=1) > 4 * 0.002 - 1e-9
        assert 0.01 < far.mean() < 0.03  # 32 of 1600 expected, with a deviation of 6
        assert noise[~far].std() == pytest.approx(0.0005, rel=0.1)
    else:
        # A few waves have an amplitude by chance; of 1600 white numbers 2 % are expected.
        spread = 0.6 if kind == "smooth" else 0.1
        assert noise[:, axes].std() == pytest.approx(0.002, rel=spread)


def test_smooth_noise_is_smooth_and_white_noise_is_not():
    ideal = ideal_goal(cloth(40, 40), "flat")
    difference = {
        kind: np.diff((add_noise(ideal, kind, 1.0, 0).goal - ideal.goal).reshape(40, 40, 3), axis=0)
        for kind in ("smooth", "white")
    }
    assert difference["smooth"].std() < 0.4 < 1.2 < difference["white"].std()


def test_right_is_as_many_points_each_near_its_own():
    ideal = ideal_goal(cloth(), "side, x")
    particles = nearest(ideal)
    assert is_right(key_points(particles, 256), ideal)
    assert not is_right(key_points(particles[:-1], 256), ideal)
    assert not is_right(key_points([*particles, 100], 256), ideal)
    assert not is_right(key_points([], 256), ideal)


@pytest.mark.parametrize(("steps", "right"), [(1, True), (2, False)])
def test_a_point_may_be_one_and_a_half_spacings_away(steps, right):
    ideal = ideal_goal(cloth(), "flat")
    assert ideal.true_points[0].tolist() == pytest.approx([-0.15, -0.15, 0.0])
    particles = nearest(ideal)
    particles[particles == 0] = steps  # along the side
    assert is_right(key_points(particles, 256), ideal) == right


def test_two_true_points_cannot_share_a_key_point():
    sheet = cloth()
    near = sheet.rest[[0, 1, 255]]
    ideal = IdealGoal("by hand", sheet, sheet.rest, near)
    assert is_right(key_points([0, 1, 255], 256), ideal)
    assert not is_right(key_points([0, 100, 255], 256), ideal)


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("rounding", [0.0, 0.01])
def test_a_rope_lies_along_its_line_with_corners_at_the_true_points(name, rounding):
    rope = bodies.rope(201, 1.0)
    ideal = ideal_line(rope, name, rounding=rounding)
    assert len(ideal.true_points) == len(LINES[name])
    steps = np.linalg.norm(np.diff(ideal.goal, axis=0), axis=1)
    assert steps.max() <= rope.spacing + ROUNDING  # nowhere stretched
    # Where it is straight it is not compressed; a corner takes two roundings and two spacings.
    bent = (len(LINES[name]) - 2) * (2 * rounding / rope.spacing + 2)
    assert (steps < rope.spacing - 1e-9).sum() <= bent + 2 * rounding / rope.spacing  # and ends
    # Directions change at the true points and nowhere else.
    turns = np.cross(np.diff(ideal.goal[:-1], axis=0), np.diff(ideal.goal[1:], axis=0))
    turning = np.flatnonzero(np.linalg.norm(turns, axis=1) > 1e-9) + 1
    away = np.abs(rope.rest[turning, None, 0] - ideal.true_points[:, 0])
    if len(LINES[name]) > 2:
        assert away.min(axis=1).max() <= rounding + rope.spacing
        assert away.min(axis=0)[1:-1].max() <= rope.spacing
    else:
        assert not turning.size


@pytest.mark.parametrize("name", SETTLED_FOLDS)
def test_a_settled_fold_is_near_the_ideal_one_and_at_rest_on_the_table(name):
    sheet = bodies.cloth((13, 13))
    found, again = settled_goal(sheet, name, 1), settled_goal(sheet, name, 1)
    assert np.array_equal(found.goal, again.goal)
    assert not np.array_equal(found.goal, settled_goal(sheet, name, 2).goal)
    ideal = ideal_goal(sheet, name)
    # Dragged and dropped: a tenth of the cloth on average, where the fold moves half of it.
    away = np.linalg.norm((found.goal - ideal.goal)[:, :2], axis=1)
    assert away.mean() < 0.03
    assert found.goal[:, 2].min() > 0.9 * sheet.radius
