"""Figures of the physics page: made at a small size, and what they claim holds there."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from experiments.physics import __main__ as command
from experiments.physics import against_mujoco, measure, resolution, self_contact, swings
from experiments.scripted import scripted_plan
from jaxsimp import goals
from jaxsimp.bodies import cloth, rope
from jaxsimp.dynamics import State, at_rest, rollout, settle
from jaxsimp.engines.mujoco.model import POISSON, stretch_stiffness
from jaxsimp.tasks import make_task


def run(*options: object) -> int:
    """What `python -m experiments.physics` does, without another process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["experiments.physics", *map(str, options)])
        return command.main()


def labels(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def check_time_step(figure):
    (axes,) = figure.axes
    assert labels(axes) == ["rope", "cloth", "order 1"]
    for line in axes.lines[:2]:  # milliseconds, and errors that fall with them
        steps, errors = line.get_xdata(), line.get_ydata()
        np.testing.assert_allclose(steps[0] / steps, [1, 2, 4])
        assert np.all(np.diff(errors) < 0)


def check_resolution(figure):
    hanging, folded = figure.axes
    assert (hanging.get_title(), labels(folded)) == ("Hanging", ["5 × 5", "9 × 9", "17 × 17"])
    # The outline of n particles a side, and a cut of n particles.
    assert [len(line.get_xdata()) for line in hanging.lines] == [4 * n for n in (5, 9, 17)]
    assert [len(line.get_xdata()) for line in folded.lines] == [5, 9, 17]
    for line in hanging.lines:  # 0.3 m, in millimetres
        assert np.ptp(line.get_xdata()) == pytest.approx(300, rel=0.1)


def check_energy(figure):
    (axes,) = figure.axes
    assert labels(axes)[-1] == "default damping and drag, 0.9"
    *undamped, damped = (line.get_ydata() for line in axes.lines)
    assert len(undamped) == 3
    assert damped[-1] < -0.01
    # First order: what a step of a tenth of the largest changes is small.
    assert np.abs(undamped[-1]).max() < 0.1 * np.abs(damped[-1])


def check_obstacles(figure):
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:4] == ["start", "action 1", "action 2", "action 3"]
    assert titles[4].startswith("settled, score 0.9")
    assert all(len(axes.collections) == 3 for axes in figure.axes)  # towel, its rim, and the bar


def check_mujoco(figure):
    *hanging, fold = figure.axes
    ways = against_mujoco.ways_to_hang(cloth((5, 5)))
    for axes, way in zip(hanging, ways, strict=True):
        assert axes.get_title().startswith(f"From {way}:")
        assert len(axes.lines) == 2 * (5 + 5)  # both engines' grids
    assert labels(hanging[-1]) == [against_mujoco.OURS, against_mujoco.MUJOCO]
    assert fold.get_title().startswith("Side fold")
    names = [label.rpartition(": ")[0] for label in labels(fold)]
    assert names == [against_mujoco.OURS, against_mujoco.TOUCHING, against_mujoco.MUJOCO]
    assert all(len(line.get_xdata()) == 5 for line in fold.lines)


def check_self_contact(figure):
    titles = [axes.get_title() for axes in figure.axes]
    assert "Without self-contact" in titles
    assert "With self-contact" in titles
    (shares,) = (axes for axes in figure.axes if axes.get_legend())
    assert labels(shares) == [
        f"{which}, {what}" for which in ("without", "with") for what in ("particle", "triangle")
    ]
    # Fewer particles are closer than LEAST to a triangle of another layer where layers touch.
    without, touching = (
        np.searchsorted(line.get_xdata(), self_contact.LEAST) / 81 for line in shares.lines[1:4:2]
    )
    assert without > 2 * touching


def check_two_sheets(figure):
    *shown, cut = figure.axes
    assert [axes.get_title() for axes in shown] == ["In the air", "Dropped", "Folded once across"]
    assert labels(cut) == ["front", "back"]
    # Four layers, less than twice as high at the crease, millimetres.
    highest = max(line.get_ydata().max() for line in cut.lines)
    assert 4 * 4 < highest < 2 * 4 * 4.2


@pytest.mark.slow
@pytest.mark.parametrize("name", command.FIGURES)
def test_a_figure_shows_its_physics_and_its_numbers_are_said(name, tmp_path, capsys, figures_saved):
    with figures_saved() as figures:
        assert run("--quick", "--only", name, "--out", tmp_path / "new") == 0
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"physics_{name}.png"]
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"{name}: ")
    ((saved, figure),) = figures.items()
    assert saved == f"physics_{name}.png"
    globals()[f"check_{name}"](figure)


def test_an_unknown_figure_is_refused(tmp_path, capsys):
    assert run("--only", "energy", "speed", "--out", tmp_path / "none") == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "unknown figure 'speed'; choose from time_step, resolution" in said.err
    assert not (tmp_path / "none").exists()


def test_a_file_for_a_folder_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert run("--out", tmp_path / "file") == 2
    assert "give a folder with --out" in " ".join(capsys.readouterr().err.split())


# --- swings --------------------------------------------------------------------------------------


def test_the_order_of_a_power_law():
    steps = np.array([0.1, 0.2, 0.4])
    assert swings.order(steps, 3.0 * steps**1.7) == pytest.approx(1.7)


def test_errors_are_of_first_order_in_the_time_step():
    steps, errors = swings.time_step_errors(rope(5), 0.1, (1, 2, 4, 8))
    np.testing.assert_allclose(steps[0] / steps, [1, 2, 4, 8])
    # What is second order is a tenth at the longest step, and halves with each.
    assert swings.order(steps[-3:], errors[-3:]) == pytest.approx(1.0, abs=0.05)


def test_energy_in_closed_form():
    body = replace(rope(2, 0.1, mass=0.02), stiffness=np.array([50.0]))
    position = np.array([[[0.0, 0.0, 1.0], [0.0, 0.3, 2.0]]])
    velocity = np.array([[[1.0, 2.0, 2.0], [0.0, 0.0, 0.0]]])
    length = np.hypot(0.3, 1.0)
    wanted = 0.01 * 9 / 2 + 50 * (length - 0.1) ** 2 / 2 + 0.01 * 9.81 * 3.0
    found = swings.energy(body, State(jnp.asarray(position), jnp.asarray(velocity)))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)  # positions are float32


# --- resolution ----------------------------------------------------------------------------------


def test_a_hanging_cloth_stretches_by_its_weight_at_any_resolution():
    shapes = {n: resolution.hanging(n) for n in (5, 9, 17)}
    sags = np.array([shape[-1, n // 2, 2] - shape[0, n // 2, 2] for n, shape in shapes.items()])
    # By a third at most: half the weight, 0.098 N, over springs of 1.5 N/m and more.
    assert ((sags > 0.305) & (sags < 0.4)).all()
    # First order in the spacing: from 1/4 to 1/8 twice as far as from 1/8 to 1/16, to a tenth
    # or so of what is second order.
    assert (sags[0] - sags[1]) / (sags[1] - sags[2]) == pytest.approx(2.0, abs=0.4)


@pytest.mark.parametrize("particles", [5, 9])
def test_a_fold_lies_on_itself(particles):
    shape = resolution.folded(particles)
    # The carried side came to the other one's, to a spacing or so, and nothing is under the table.
    assert np.abs(shape[0, :, 0] - shape[-1, :, 0]).max() < 0.3 / (particles - 1)
    assert shape[..., 2].min() > 0.0019


# --- against MuJoCo ------------------------------------------------------------------------------


def springs_energy(body, position):
    """Of stretched springs."""
    ends = position[body.springs]
    length = jnp.sqrt(((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=-1))
    return (body.stiffness * (length - body.rest_length) ** 2).sum() / 2


def membrane_energy(body, position):
    """Of triangles of Saint Venant's and Kirchhoff's material, that resist no bending."""
    flat = np.stack(
        [body.rest[body.faces[:, i], :2] - body.rest[body.faces[:, 0], :2] for i in (1, 2)], 2
    )
    ends = jnp.stack([position[body.faces[:, i]] - position[body.faces[:, 0]] for i in (1, 2)], 2)
    gradient = ends @ np.linalg.inv(flat)
    strain = (gradient.swapaxes(1, 2) @ gradient - np.eye(2)[None]) / 2
    trace = strain[:, 0, 0] + strain[:, 1, 1]
    dense = POISSON * trace**2 + (1 - POISSON) * (strain**2).sum(axis=(1, 2))
    young = stretch_stiffness(body, body.stiffness) / (1 - POISSON**2)
    return young / 2 * (np.abs(np.linalg.det(flat)) / 2 * dense).sum()


def of_least_energy(elastic, body, start, held):
    """Where a body hangs that has the least elastic and potential energy."""
    free = np.setdiff1d(np.arange(len(start)), held)

    @jax.jit
    def energy(moved):
        position = jnp.asarray(start).at[free].set(moved.reshape(-1, 3))
        return 1e3 * (elastic(body, position) + 9.81 * (body.mass * position[:, 2]).sum())

    found = minimize(
        jax.jit(jax.value_and_grad(energy)),
        start[free].ravel(),
        jac=True,
        tol=1e-10,
        options={"maxiter": 5000},
    )
    position = start.copy()
    position[free] = found.x.reshape(-1, 3)
    return position


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("way", ["an edge", "two corners"])
@pytest.mark.parametrize(
    ("hang", "elastic", "springs", "tolerance"),
    [
        (measure.hang, springs_energy, {}, 1e-7),
        # Without springs that bending shortens; what is held gives way by 2 micrometres.
        (
            against_mujoco.hang_in_mujoco,
            membrane_energy,
            {"bend_stiffness": 1e-6, "shear_stiffness": 1e-6},
            1e-5,
        ),
    ],
)
def test_what_hangs_has_the_least_energy_of_its_material(way, hang, elastic, springs, tolerance):
    body = cloth((5, 5), drag=15.0, **springs)
    held = against_mujoco.ways_to_hang(body)[way].held
    start = measure.upright(body)  # in a plane, where it stays
    found = hang(body, start, held, 4.0)
    np.testing.assert_allclose(found, of_least_energy(elastic, body, start, held), atol=tolerance)
    assert np.abs(found - start).max() > 0.03


def test_a_stiffened_body_is_as_near_to_critical_damping():
    body = cloth((5, 5))
    stiff = against_mujoco.stiffened(body, 4.0)
    np.testing.assert_allclose(stiff.stiffness, 4 * body.stiffness)
    np.testing.assert_allclose(
        stiff.damping / np.sqrt(stiff.stiffness), body.damping / np.sqrt(body.stiffness)
    )


def test_a_plan_is_carried_out_and_the_body_settles():
    task = make_task("cloth_side_folding", 5)
    episode = task.episode_fn(0)
    plan = scripted_plan(task, episode)
    found = against_mujoco.carry_out(task, episode, plan, self_contact=False)
    simulation = task.simulation()
    state, _ = rollout(simulation, task.pickers(), at_rest(episode.start), plan)
    state = settle(simulation, state, task.settle_actions * task.action_steps)
    # The same steps, compiled otherwise, in float32.
    np.testing.assert_allclose(found, state.position, atol=1e-5)
    assert np.abs(found - np.asarray(episode.start)).max() > 0.2


@pytest.mark.parametrize("angle", [-0.7, 0.0, 0.4])
@pytest.mark.parametrize(("diagonal", "half"), [(False, 0.15), (True, 0.15 * np.sqrt(2))])
def test_a_cut_runs_through_the_middle_however_the_start_was_turned(angle, diagonal, half):
    body = cloth((5, 5))
    start = goals.flat(body, angle)
    position = against_mujoco.unturned(body, start, start)
    np.testing.assert_allclose(position, goals.flat(body), atol=1e-12)
    cut = against_mujoco.middle(body, diagonal)
    along = against_mujoco.along_cut(body, cut, position[cut])
    np.testing.assert_allclose(along, np.linspace(-half, half, 5), atol=1e-12)


# --- self-contact --------------------------------------------------------------------------------


def test_distances_of_a_pair_of_layers_made_by_hand():
    body = cloth((9, 9), (0.4, 0.4))  # cells of 50 mm
    position = body.rest.reshape(9, 9, 3).copy()
    position[:4] = position[:4:-1]  # the first rows above the last
    position[:4] += [0.0, 0.02, 0.006]
    position = position.reshape(-1, 3)
    may_touch = np.linalg.norm(body.rest[:, None] - body.rest[None], axis=-1) > 0.12
    particles = self_contact.nearest_particles(body, position, may_touch).reshape(9, 9)
    triangles = self_contact.nearest_triangles(body, position, may_touch).reshape(9, 9)
    # Rows 0 to 2 are at rest eight, six and four cells from those that they lie on; row 3, at
    # two cells, may touch the next row only.
    np.testing.assert_allclose(particles[:3], np.hypot(0.02, 0.006), rtol=1e-12)
    # The last column is moved beyond the edge below.
    np.testing.assert_allclose(triangles[:2, :-1], 0.006, rtol=1e-12)
    np.testing.assert_allclose(triangles[:2, -1], np.hypot(0.02, 0.006), rtol=1e-12)
    np.testing.assert_allclose(triangles[3, :-1], np.hypot(0.05, 0.006), rtol=1e-12)
    np.testing.assert_allclose(particles[3], np.sqrt(0.05**2 + 0.02**2 + 0.006**2), rtol=1e-12)


def test_a_cut_of_a_flat_cloth_is_as_long_as_its_side():
    body = cloth((5, 7), (0.3, 0.2))
    ends = self_contact.cut(body, body.rest, np.array([0.01, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(ends[..., 0], 0.01, atol=1e-12)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(0.2, rel=1e-12)


def test_what_is_carried_over_goes_up_and_down_to_the_gap():
    way = np.array([0.3, -0.1, 0.004])
    moves = self_contact.over(way, 0.1, 0.006)
    np.testing.assert_allclose(moves.sum(axis=0), way + np.array([0, 0, 0.006]), atol=1e-15)
    np.testing.assert_allclose(moves[:2].sum(axis=0), way / 2 + np.array([0, 0, 0.1]), atol=1e-15)


def test_a_cloth_folded_twice_is_a_quarter_of_it():
    position, missed = self_contact.folded_twice(9, self_contact=False)
    assert missed == 0
    # Both creases end in the right angle; corners were carried 0.95 of the way, 20 mm short.
    corners = position[[0, 8, 72, 80]]
    assert np.linalg.norm(corners[0] - corners[3]) < 0.05
    assert np.linalg.norm(corners[1] - corners[2]) < 0.05
    half = 0.15 * np.sqrt(2)
    assert np.ptp(position[:, :2], axis=0) == pytest.approx([half, half], abs=0.05)
