"""The report: intervals, what it chooses to show, and runs that failed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments import plan_report
from jaxsimp.records import markdown


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [
        # Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in
        # Medicine 1998, Table I, method 3 (Wilson's score without continuity correction).
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_success_interval_is_that_of_the_literature(successes, count, low, high):
    found = markdown.success_interval(successes, count)
    assert found == pytest.approx((low, high), abs=5e-5)  # the table has four digits


@given(st.integers(1, 200), st.data())
def test_success_interval_is_wilsons_formula(count, data):
    successes = data.draw(st.integers(0, count))
    rate, z = successes / count, 1.959963984540054
    middle = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = np.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2)) * z / (1 + z**2 / count)
    found = markdown.success_interval(successes, count)
    assert found == pytest.approx((middle - half, middle + half), abs=1e-9)
    assert 0 <= found[0] <= rate <= found[1] <= 1


def row(seed, score, space="key_points", **fields) -> dict:
    return {
        "task": "t",
        "planner": "default",
        "action_space": space,
        "pick_encoding": "categorical",
        "seed": seed,
        "final_score": score,
        "success": score is not None and score >= 0.9,
        "cost_per_question": [2.0, 1.0],
        "rollouts_per_question": [4, 8],
        "counted_rollouts": 8,
        "same_folds": None,
        "non_finite": 0,
        "plan_seconds": 1.0 + seed,
        "compile_seconds": 0.5,
        "plan": f"{space}-{seed}.npz",
    } | fields


def test_the_plan_shown_is_the_median_one_of_the_first_method():
    scores = [0.3, 0.9, None, 0.5, 0.7]
    rows = [row(seed, score) for seed, score in enumerate(scores)]
    rows += [row(seed, -seed, "all_particles") for seed in range(5)]
    assert plan_report._typical_seed(rows) == 3  # None is worst of all: 0.5 is in the middle


def test_run_table_summarises_each_method():
    rows = [row(seed, score) for seed, score in enumerate([0.95, 0.2, 0.91])]
    rows += [row(0, None, "all_particles", non_finite=8, cost_per_question=[None, None])]
    table = plan_report._run_table(rows, [])
    assert len(table) == 4
    first = [cell.strip() for cell in table[2].strip("|").split("|")]
    assert first[:3] == ["t", "key points, categorical", "0.910 (0.200 to 0.950)"]
    assert first[3].startswith("2/3 (")
    assert first[4:] == ["–", "8", "0", "2.0", "1.5"]
    failed = [cell.strip() for cell in table[3].strip("|").split("|")]
    assert failed[3].startswith("0/1 (")
    assert failed[6] == "8"
    # Two of them have been replayed in MuJoCo.
    replayed = [rows[seed] | {"mujoco_full_score": score} for seed, score in [(0, 0.5), (2, 0.7)]]
    table = plan_report._run_table(rows, replayed)
    cells = [line.strip("|").split("|")[-1].strip() for line in table[2:]]
    assert cells == ["0.600 (0.500 to 0.700)", "not replayed"]


def test_costs_have_a_row_a_run_and_nothing_finite_is_not_a_number():
    rows = [row(0, 0.1), row(1, None, cost_per_question=[None, 3.0])]
    ((name, costs),) = plan_report._costs(rows).items()
    assert name == "key points, categorical"
    np.testing.assert_array_equal(costs, [[2.0, 1.0], [np.nan, 3.0]])
