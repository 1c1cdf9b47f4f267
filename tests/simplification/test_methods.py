"""The doors `simplify` and `simplify_batch`: workspaces reach the methods, and refusals say why."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals
from jaxsimp.bodies import cloth, rope
from jaxsimp.simplification import (
    FitStatus,
    Workspace,
    simplify,
    simplify_batch,
    simplify_optimal,
    simplify_uniform,
)

ROPE, CLOTH = rope(), cloth((9, 9))
BENT = goals.polyline(ROPE, np.array([[0, 0], [0.3, 0], [0.3, 0.2]]))
TABLE = Workspace(above_table=True)
EXACT = 1e-7
"""The backend's own accuracy, metres."""


@pytest.mark.parametrize(
    ("method", "function"), [("robust", simplify_optimal), ("paper", simplify_uniform)]
)
def test_a_workspace_reaches_the_method(method, function):
    workspace = Workspace(
        lower=(-1.0, -1.0, 0.0), upper=(0.29, 1.0, 1.0), above_table=True, max_stretch=0.05
    )
    found = simplify(ROPE, BENT, method=method, tolerance=0.02, workspace=workspace)
    (expected,) = function(ROPE, BENT[None], 0.02, workspace=workspace)
    np.testing.assert_array_equal(found.positions, expected.positions)
    assert found.positions[:, 0].max() <= 0.29 + EXACT
    assert found.positions[:, 2].min() >= ROPE.radius - EXACT
    assert simplify(ROPE, BENT, method=method, tolerance=0.02).positions[:, 0].max() > 0.29


def test_an_infeasible_goal_of_a_batch_is_a_status():
    low = BENT - [0.0, 0.0, 0.004]
    workspace = Workspace(above_table=True, fixed_ends=True)
    found = simplify_batch(ROPE, np.stack([BENT, low]), workspace=workspace)
    assert [each.status for each in found] == [FitStatus.FITS, FitStatus.INFEASIBLE]
    assert len(found[1]) == 0


def stretched():
    goal = goals.straight(ROPE)
    return np.stack([1.01 * goal[:, 0], goal[:, 1], goal[:, 2]], axis=1)


@pytest.mark.parametrize(
    ("goal", "workspace", "told"),
    [
        (
            BENT,
            Workspace(upper=(1.0, 1.0, 0.001), above_table=True),
            r"ends at z = 0\.001 m, .* keeps 0\.\d+ m above the table; raise upper, or leave above",
        ),
        (
            BENT,
            Workspace(lower=(0.1, -1.0, -1.0), fixed_ends=True),
            r"its first particle is at \(0, 0, 0\.\d+\) m, outside \(0\.1, -1, -1\) m to "
            r"\(inf, inf, inf\) m; move the goal, widen lower and upper, or leave fixed_ends out",
        ),
        (
            BENT,
            Workspace(upper=(1.0, 0.1, 1.0), fixed_ends=True),
            r"its last particle is at \(0\.3, 0\.2, 0\.\d+\) m, outside",
        ),
        (
            stretched(),
            Workspace(fixed_ends=True, max_stretch=0.0),
            r"its ends are 0\.505 m apart, and the model is 0\.5 m long at most; raise max_stretch",
        ),
    ],
)
def test_an_infeasible_goal_is_refused_with_the_limit_and_the_remedy(goal, workspace, told):
    with pytest.raises(ValueError, match=told):
        simplify(ROPE, goal, workspace=workspace)


@pytest.mark.parametrize("method", ["robust", "paper", "meshlab"])
def test_a_workspace_of_a_surface_is_refused(method):
    told = r"is a surface of 128 triangles; only models of ropes keep to a workspace: leave it out"
    with pytest.raises(ValueError, match=told):
        simplify(CLOTH, CLOTH.rest, method=method, workspace=TABLE)
    with pytest.raises(ValueError, match=told):
        simplify_batch(CLOTH, np.zeros((0, 81, 3)), method=method, workspace=TABLE)


# --- what is no goal, and no option --------------------------------------------------------------


@pytest.mark.parametrize("method", ["robust", "paper"])
@pytest.mark.parametrize("body", [rope(5), cloth((5, 5))], ids=["rope", "cloth"])
def test_a_goal_of_no_size_of_the_body_is_refused_by_both_methods(body, method):
    goal = goals.flat(body)
    for far in (1e6, 1e16, 1e300):
        astray = goal.copy()
        astray[1, 0] = far
        with pytest.raises(ValueError, match=r"has particle 1 at x = .*; 50 m from the origin"):
            simplify(body, astray, method=method)
    with pytest.raises(ValueError, match=r"millimetres\? scale=0\.001, or multiply by 0\.001"):
        simplify(body, 1000 * goal, method=method)
    with pytest.raises(ValueError, match=r"have 0 of their length at rest; 0\.1 is the least"):
        simplify_batch(body, np.stack([goal, 0 * goal]), method=method)
    assert simplify(body, goal + np.array([40.0, 0.0, 0.0]), method=method).max_error < 1e-5


@pytest.mark.parametrize("method", ["robust", "paper"])
@given(seed=st.integers(0, 10**6), share=st.floats(1e-3, 0.1), tolerance=st.floats(1e-4, 0.05))
def test_the_status_of_a_rope_is_that_of_the_error_that_is_told(method, seed, share, tolerance):
    noise = share * np.random.default_rng(seed).normal(size=BENT.shape)
    (found,) = simplify_batch(ROPE, (BENT + noise)[None], method=method, tolerance=tolerance)
    fits = found.rms_error < tolerance and found.error < tolerance
    assert found.status == (FitStatus.FITS if fits else FitStatus.NO_FIT)
    assert found.rms_error == pytest.approx(found.error, rel=1e-4)


def test_a_goal_that_is_torn_everywhere_is_a_model_or_a_status():
    torn = np.random.default_rng(0).uniform(-0.2, 0.2, (81, 3))
    (found,) = simplify_batch(CLOTH, torn[None], method="paper", max_size=8)
    assert found.status == FitStatus.NO_FIT
    assert found.error > found.tolerance


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: simplify(ROPE, BENT, method=None), "method is None; choose from robust, paper"),
        (lambda: simplify(ROPE, BENT, method=["paper"]), r"method is \['paper'\]; choose from"),
        (lambda: simplify(ROPE, BENT, tolerance=np.nan), "tolerance is nan; give a number"),
        (lambda: simplify(ROPE, BENT, tolerance=True), "tolerance is True; give a number"),
        (lambda: simplify(CLOTH, CLOTH.rest, tolerance=1j), "tolerance is 1j; give a number"),
        (lambda: simplify(ROPE, BENT, max_size=2.5), "max_size is 2.5; give a whole number of at"),
        (lambda: simplify(CLOTH, CLOTH.rest, max_size=True), "max_size is True; give a whole"),
        (lambda: simplify(ROPE, BENT, workspace=(0, 1)), r"workspace is \(0, 1\); give a jaxsimp"),
        (lambda: simplify(ROPE, BENT[None]), r"the goal has shape \(1, 41, 3\); give shape \(41"),
        (lambda: simplify_batch(ROPE, BENT), r"goals has shape \(41, 3\); give shape \(B, 41, 3\)"),
        (lambda: simplify(ROPE, BENT.astype(object)), "the goal is an array of object, .*; give"),
        (lambda: simplify_batch(ROPE, 5), r"goals has shape \(\); give shape \(B, 41, 3\), a"),
        (lambda: simplify_batch(ROPE, None), r"goals is None; give an array of shape \(B, N, 3"),
        (lambda: simplify_batch(ROPE, [2.5, BENT]), r"the goal has shape \(\); give shape \(41, 3"),
        (lambda: Workspace(lower=(0.0, 0.0, np.inf)), r"lower is \(0.0, 0.0, inf\); give x, y and"),
        (lambda: Workspace(lower=(0.0, 0.0)), r"lower is \(0.0, 0.0\); give x, y and z in metres"),
        (lambda: Workspace(upper=1j), "upper is 1j; give x, y and z in metres, -inf or inf for no"),
        (lambda: Workspace(above_table="no"), "above_table is 'no'; give True or False"),
        (lambda: Workspace(max_stretch=1e9), "max_stretch is 1000000000.0; give a number from"),
    ],
)  # fmt: skip
def test_what_is_no_option_is_refused_where_it_is_given(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("method", ["robust", "paper"])
def test_no_goals_have_no_key_points(method):
    assert simplify_batch(ROPE, np.zeros((0, 41, 3)), method=method) == []
