"""The doors `simplify` and `simplify_batch`: workspaces reach the methods, and refusals say why."""

import numpy as np
import pytest

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
