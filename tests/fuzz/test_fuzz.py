"""A few hundred inputs with a fixed seed, and that the fuzzer itself judges right."""

import jaxtyping
import pytest

from tests.fuzz.core import FINE, Door, Input, Outcome, parameters_of
from tests.fuzz.doors import all_doors
from tests.fuzz.refusals import faults_of_refusal
from tests.fuzz.values import count

SEED = 0
QUICK = 10
"""Doors of less weight compile, simulate or draw: they are left to the command."""


def _doors() -> dict[str, Door]:
    """The doors, made as users have it: without checks of annotations."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        return all_doors()
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


DOORS = _doors()


@pytest.fixture(autouse=True)
def as_users_have_it(unchecked_shapes: None, rank_promotion: None) -> None:
    """Without checks of annotations, which users do not have."""


@pytest.mark.parametrize("name", [name for name, door in DOORS.items() if door.weight >= QUICK])
def test_inputs_are_right_or_refused_well(name):
    wrong = [
        f"{one.outcome}: {one.text}: {one.detail} (--door {name} --index {one.index})"
        for one in (DOORS[name].judge(SEED, index) for index in range(DOORS[name].weight // 2))
        if one.outcome not in FINE
    ]
    assert not wrong, "\n".join(wrong)


def _judged(function, is_valid, argument):
    door = Door("test", function, {"size": count(1, 9)}, lambda size: is_valid)
    return door.judge_input(Input({"size": argument}, frozenset({"size"}))).outcome


def _refuse(text):
    def refuse(size):
        raise ValueError(text.format(size))

    return refuse


def test_each_outcome_is_told():
    well = _refuse("size is {}; give a whole number from 1 to 9")
    assert _judged(lambda size: size, True, 3) == Outcome.RIGHT
    assert _judged(lambda size: size, False, 12) == Outcome.SILENT
    assert _judged(well, False, 12) == Outcome.REFUSED_WELL
    assert _judged(well, True, 3) == Outcome.VALID_REFUSED
    assert _judged(_refuse("wrong size"), False, 12) == Outcome.REFUSED_BADLY
    assert _judged(lambda size: size + "a", False, 12) == Outcome.OTHER
    assert _judged(lambda size: [][size], False, 12) == Outcome.OTHER
    assert _judged(lambda size, /: int("x"), False, 12) == Outcome.OTHER


def test_a_failed_check_is_silent():
    def check(result, size):
        assert result == size, "another size"

    door = Door("test", lambda size: size + 1, {"size": count(1, 9, optional=False)}, check=check)
    outcomes = {door.judge(0, index).outcome for index in range(9)}
    assert Outcome.SILENT in outcomes


def test_a_hang_is_told():
    def hang(size):
        while True:
            pass

    door = Door("test", hang, {"size": count(1, 9, optional=False)}, seconds=0.05)
    assert door.judge(0, 0).outcome == Outcome.HANG


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("size is 12; give a whole number from 1 to 9", []),
        ("size is 12; at least 1 is needed", ["remedy"]),
        ("the size is wrong; give a whole number", ["value"]),
        ("size is 12; give it", ["limit"]),
        ("invalid", ["value", "limit", "remedy"]),
    ],
)
def test_what_a_refusal_lacks(text, faults):
    assert faults_of_refusal(text, {"size": 12}) == faults


def test_an_input_depends_on_seed_door_and_index_alone():
    door = DOORS["bodies.rope"]
    assert str(door.draw(1, 5)) == str(door.draw(1, 5))
    assert len({str(door.draw(seed, index)) for seed in range(3) for index in range(9)}) > 20


def test_doors_have_the_parameters_of_their_functions():
    for name in ("bodies.rope", "bodies.cloth", "bodies.from_mesh", "dynamics.make_simulation"):
        door = DOORS[name]
        missing = parameters_of(door.function) - door.parameters.keys() - {"material"}
        assert not missing, f"{name} draws no {', '.join(missing)}"
