"""Pictures: what is drawn, from ordinary data and from data with failures in it."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy import stats

from jaxsimp import goals, viz
from jaxsimp.bodies import cloth, from_mesh, rope
from jaxsimp.bodies.garments import skirt
from jaxsimp.bodies.topology import boundary_edges
from jaxsimp.dynamics import Box, Capsule, Plane, Sphere, Table, table_with_edge
from jaxsimp.simplification import FitStatus, KeyPoints


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def rope_model() -> KeyPoints:
    return KeyPoints(
        particles=np.array([0, 4, 8]),
        positions=np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.0], [0.2, 0.0, 0.0]]),
        elements=np.array([[0, 1], [1, 2]]),
        num_particles=9,
        method="by hand",
        sizes=(2, 3),
        errors=(0.02, 0.001),
        tolerance=0.005,
        max_error=0.0,
        rms_error=0.0,
    )


def cloth_model() -> KeyPoints:
    return KeyPoints(
        particles=np.array([0, 4, 20, 24]),
        positions=np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.3, 0.0, 0.0], [0.3, 0.3, 0.0]]),
        elements=np.array([[0, 2, 1], [2, 3, 1]]),
        num_particles=25,
        method="by hand",
        sizes=(4,),
        errors=(0.0,),
        tolerance=0.005,
        max_error=0.0,
        rms_error=0.0,
    )


# --- intervals -----------------------------------------------------------------------------------


@given(st.integers(2, 12), st.integers(1, 4), st.integers(0, 10**6))
def test_mean_interval_is_that_of_scipy(runs, columns, seed):
    values = np.random.default_rng(seed).normal(3.0, 2.0, (runs, columns))
    mean, half = viz.mean_interval(values)
    low, high = stats.t.interval(
        0.95, runs - 1, loc=values.mean(axis=0), scale=stats.sem(values, axis=0)
    )
    np.testing.assert_allclose(mean - half, low, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mean + half, high, rtol=1e-9, atol=1e-9)


def test_mean_of_one_run_has_no_interval():
    mean, half = viz.mean_interval(np.array([[1.0, 2.0]]))
    np.testing.assert_array_equal(mean, [1.0, 2.0])
    assert np.all(np.isnan(half))


# --- figures -------------------------------------------------------------------------------------


def test_model_errors_are_drawn_in_millimetres_with_the_chosen_size():
    figure = viz.plot_model_errors({"some_task": rope_model()})
    (axes,) = figure.axes
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [2, 3])
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [20.0, 1.0])
    assert axes.get_title() == "some task"
    assert any("3 key points" in text.get_text() for text in axes.get_legend().get_texts())
    assert axes.get_ylim()[0] <= 0 <= 20.0 <= axes.get_ylim()[1]
    figure.canvas.draw()


def test_models_are_drawn_over_their_goals():
    flat = cloth((5, 5))
    line = rope(9)
    figure = viz.plot_models(
        {
            "rope": (line, goals.flat(line), rope_model()),
            "cloth": (flat, goals.flat(flat), cloth_model()),
            "third": (line, goals.flat(line), rope_model()),
        }
    )
    assert [axes.get_title() for axes in figure.axes] == [
        "rope: 3 key points",
        "cloth: 4 key points",
        "third: 3 key points",
    ]
    first, second, _ = figure.axes
    for axes, body, model in ((first, line, rope_model()), (second, flat, cloth_model())):
        assert_is_at(axes, body, goals.flat(body))
        stars = axes.collections[-1]
        np.testing.assert_allclose(np.transpose(stars._offsets3d), model.positions)
        # Segments, or triangles that end where they begin; a rope's goal is a line, too.
        elements = axes.lines[-len(model.elements) :]
        for element, artist in zip(model.elements, elements, strict=True):
            corners = element if len(element) == 2 else [*element, element[0]]
            drawn = np.transpose(artist.get_data_3d())
            np.testing.assert_allclose(drawn, model.positions[corners])
    figure.canvas.draw()


def test_simplifications_have_a_row_each_with_errors_beside_the_model():
    flat, line = cloth((5, 5)), rope(9)
    none = replace(rope_model(), status=FitStatus.NO_FIT, errors=(np.inf, 0.2))
    figure = viz.plot_simplifications(
        {
            "my_$file$": (flat, goals.flat(flat), cloth_model()),
            "rope": (line, goals.flat(line), none),
        }
    )
    first, errors, second, others = figure.axes
    assert (first.name, errors.name, second.name) == ("3d", "rectilinear", "3d")
    assert [axes.get_title() for axes in (first, second)] == [r"my \$file\$", "rope"]
    np.testing.assert_allclose(errors.lines[0].get_ydata(), [0.0])
    assert [text.get_text() for text in others.get_legend().get_texts()] == [
        "tolerance",
        "none fits, last tried: 3 key points",
    ]
    # The ends of a row are at one height, and the rows below each other.
    boxes = [axes.get_subplotspec().get_position(figure) for axes in figure.axes]
    assert boxes[0].y0 == boxes[1].y0 > boxes[2].y0 == boxes[3].y0
    assert boxes[0].x1 < boxes[1].x0
    figure.canvas.draw()


def test_costs_are_drawn_as_means_with_their_intervals():
    runs = np.array([[3.0, 2.0, 1.0], [5.0, 2.0, 0.0]])
    figure = viz.plot_costs({"task": {"one": runs, "two": runs[:1] + 1}})
    (axes,) = figure.axes
    np.testing.assert_allclose(axes.lines[0].get_ydata(), [4.0, 2.0, 0.5])
    np.testing.assert_allclose(axes.lines[1].get_ydata(), [4.0, 3.0, 2.0])
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [1, 2, 3])
    # t with 1 degree of freedom is 12.706 at 97.5 %; sem of 3 and 5 is 1
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(4 + 12.706, abs=1e-3)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["one", "two"]
    figure.canvas.draw()


def test_costs_that_are_not_finite_are_left_out():
    runs = np.array([[np.nan, 2.0], [1.0, 1.0]])
    nothing = np.full((2, 2), np.nan)
    figure = viz.plot_costs({"task": {"some": runs, "none": nothing}})
    figure.canvas.draw()
    assert np.isnan(figure.axes[0].lines[1].get_ydata()).all()


def assert_is_at(axes, body, positions):
    """The body that is drawn is at these positions: a rope's line, or a cloth's boundary."""
    if len(body.faces):
        (outline,) = (each for each in axes.collections if isinstance(each, Line3DCollection))
        drawn = np.concatenate(outline._segments3d)
        wanted = np.concatenate(positions[boundary_edges(body.faces)[0]])
    else:
        drawn, wanted = np.transpose(axes.lines[0].get_data_3d()), positions
    np.testing.assert_allclose(drawn, wanted)


@pytest.mark.parametrize("body", [rope(9), cloth((5, 5))], ids=["rope", "cloth"])
def test_executions_are_drawn_frame_by_frame(body):
    start = goals.flat(body)
    frames = np.stack([start, start + np.array([0.0, 0.0, 0.1]), start])
    figure = viz.plot_executions(
        body, start, {"method one": (frames, 0.5), "method two": (frames, -1.0)}, "a_task"
    )
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:4] == ["start", "action 1", "settled, score 0.50", "goal"]
    assert titles[6] == "settled, score -1.00"
    limits = {(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}
    assert len(limits) == 1  # one scale: frames can be compared
    for axes, frame in zip(figure.axes, [*frames, start] * 2, strict=True):
        assert_is_at(axes, body, frame)
    figure.canvas.draw()


OBSTACLES = {
    "sphere": Sphere((0.02, 0.01, 0.04), 0.05),
    "capsule": Capsule((-0.05, 0.0, 0.05), (0.06, 0.01, 0.06), 0.03),
    "box": Box((0.0, 0.02, 0.05), (0.06, 0.03, 0.04), 0.01, 0.4),
    "plane": Plane((0.0, 0.0, 0.05), (0.3, 0.0, 1.0)),
}


def corners_of(surface):
    """Corners of what a surface was drawn with, shape (3, corners)."""
    if hasattr(surface, "_faces"):
        return np.reshape(surface._faces, (-1, 3)).T
    return surface._vec[:3]  # before Matplotlib 3.11


@pytest.mark.parametrize("obstacle", OBSTACLES.values(), ids=OBSTACLES.keys())
def test_an_obstacle_is_drawn_where_its_surface_is(obstacle):
    axes = plt.figure().add_subplot(projection="3d")
    axes.set(xlim=(-0.2, 0.2), ylim=(-0.2, 0.2), zlim=(-0.1, 0.2))
    viz.draw_obstacle(axes, obstacle)
    (surface,) = axes.collections
    axes.figure.canvas.draw()
    corners = corners_of(surface)
    # Seen from 10 m in float32: 1e-6 m of 10 m, a few times over.
    np.testing.assert_allclose(obstacle.distance(*corners)[0], 0.0, atol=1e-5)
    # It is all around: its extents are those of the obstacle, found by distances from outside.
    if not isinstance(obstacle, Plane):
        for axis in range(3):
            for side, extent in ((1.0, corners[axis].max()), (-1.0, -corners[axis].min())):
                far = 1e3 * side * np.eye(3)[axis]
                wanted = 1e3 - float(obstacle.distance(*far)[0])
                assert extent == pytest.approx(wanted, abs=1.5e-3)  # a grid of 7.5 degrees


def test_obstacles_are_cut_off_at_the_limits_of_the_picture():
    axes = plt.figure().add_subplot(projection="3d")
    axes.set(xlim=(-0.2, 0.2), ylim=(-0.1, 0.1), zlim=(-0.1, 0.2))
    viz.draw_obstacle(axes, Table())  # the bottom of the picture
    assert not axes.collections
    viz.draw_obstacle(axes, table_with_edge(0.1))
    axes.figure.canvas.draw()
    corners = corners_of(axes.collections[0])
    np.testing.assert_allclose(corners.min(axis=1), [-0.2, -0.1, -0.1])
    np.testing.assert_allclose(corners.max(axis=1), [0.1, 0.1, 0.0], atol=1e-5)


def test_executions_are_drawn_with_their_obstacles():
    body = rope(9)
    start = goals.flat(body)
    frames = np.stack([start, start])
    ball = Sphere((0.0, 0.0, 0.0), 0.1)
    figure = viz.plot_executions(body, start, {"one": (frames, 0.5)}, "a_task", (ball, Table()))
    counts = [
        sum(isinstance(c, Poly3DCollection) for c in axes.collections) for axes in figure.axes
    ]
    assert counts == [1, 1, 1]
    figure.canvas.draw()


@pytest.mark.parametrize("body", [rope(9), cloth((5, 5))], ids=["rope", "cloth"])
def test_an_execution_that_failed_is_drawn_without_its_lost_frames(body):
    start = goals.flat(body)
    frames = np.stack([start, np.full_like(start, np.nan), np.full_like(start, np.inf)])
    figure = viz.plot_executions(body, start, {"failed": (frames, -np.inf)}, "a_task")
    figure.canvas.draw()
    assert np.all(np.isfinite(figure.axes[0].get_xlim()))
    drawn = [bool(axes.lines or axes.collections) for axes in figure.axes]
    assert drawn == [True, False, False, True]


def ball():
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    return from_mesh(np.array(solid.vertices), np.array(solid.faces))


@pytest.mark.parametrize(
    ("make", "around"),
    [
        (lambda: cloth((5, 4), (0.3, 0.2)), 1.0),
        (lambda: skirt(0.3, 0.2, hem=0.2, num_particles=80).body, 1.0),
        (ball, 0.0),
    ],
    ids=["cloth", "skirt", "ball"],
)
def test_a_surface_of_any_topology_is_drawn_with_its_boundary(make, around):
    body = make()
    axes = plt.figure().add_subplot(projection="3d")
    viz.draw_body(axes, body, body.rest, "red")
    surface, *lines = axes.collections
    assert len(surface.get_facecolor()) == len(body.faces)
    segments = np.concatenate(
        [np.array(line._segments3d) for line in lines] or [np.zeros((0, 2, 3))]
    )
    drawn = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert drawn == pytest.approx(around)
    axes.figure.canvas.draw()


def test_importing_viz_does_not_import_matplotlib():
    import subprocess
    import sys
    from pathlib import Path

    code = "import sys, jaxsimp.viz; sys.exit('matplotlib' in sys.modules)"
    root = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0


@pytest.mark.parametrize(
    "draw",
    [
        viz.plot_model_errors,
        viz.plot_models,
        viz.plot_simplifications,
        viz.plot_costs,
        lambda none: viz.plot_scores(none, "ours", "theirs", 0.9),
        lambda none: viz.plot_executions(rope(5), np.zeros((5, 3)), none, "nothing"),
    ],
)
def test_nothing_to_draw_is_refused(draw):
    with pytest.raises(ValueError, match="nothing to draw; give at least one entry"):
        draw({})


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda: viz.plot_costs({"a": {"m": 1j}}), "costs of a, m is 1j; give real numbers, a row"),
        (
            lambda: viz.plot_scores({"a": {"m": np.ones(3)}}, "ours", "theirs", 0.9),
            r"scores of a, m has shape \(3,\); give shape \(R, 2\), the two scores",
        ),
        (
            lambda: viz.plot_models({"a": (rope(9), np.ones((9, 2)), rope_model())}),
            r"the goal has shape \(9, 2\); give shape \(9, 3\)",
        ),
        (
            lambda: viz.plot_executions(rope(5), rope(5).rest, {"m": (1.0, 0.5)}, "title"),
            r"positions of m has shape \(\); give shape \(P, 5, 3\)",
        ),
        (
            lambda: viz.plot_executions(rope(5), rope(5).rest, {"m": ([rope(5).rest], 0.5)}, "t"),
            "positions of m are 1 rows; give at least 2, at the start and settled",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused(draw, message):
    with pytest.raises(ValueError, match=message):
        draw()


def test_plans_of_different_lengths_have_a_frame_for_each_action():
    body = rope(5)
    frames = np.stack([body.rest] * 4)
    figure = viz.plot_executions(body, body.rest, {"a": (frames, 0.5), "b": (frames[:3], 0.5)}, "t")
    assert [axes.get_title() for axes in figure.axes][5:] == [
        "start", "action 1", "settled, score 0.50", "goal",
    ]  # fmt: skip


def test_a_goal_at_one_place_is_drawn():
    figure = viz.plot_simplifications({"a": (rope(9), np.zeros((9, 3)), rope_model())})
    figure.canvas.draw()


def test_scores_that_are_not_finite_are_left_out_of_the_limits():
    pairs = np.array([[0.9, -np.inf], [0.5, np.nan], [-0.2, 0.3]])
    figure = viz.plot_scores({"a": {"m": pairs}}, "ours", "theirs", 0.9)
    assert figure.axes[0].get_xlim() == pytest.approx((-0.25, 1.05))
