"""The registry: groups, scales, names that are taken or unknown."""

import pytest

from jaxsimp import tasks
from jaxsimp.tasks import make_task, task_names

ROPES = ("rope_straightening", "rope_folding")
FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")
GARMENTS = ("t_shirt_sleeves_in", "trousers_leg_over_leg")


def test_the_four_tasks_of_the_paper_are_registered():
    assert set(task_names("paper")) == {*ROPES, *FOLDS}


def test_groups_are_all_tasks():
    assert set(task_names()) == {*task_names("paper"), *task_names("goals")}
    assert len(task_names("goals")) == 8
    assert task_names("none") == ()


@pytest.mark.parametrize("name", task_names())
@pytest.mark.parametrize("resolution", [5, 6, 13])
def test_tasks_have_other_resolutions(name, resolution):
    task = make_task(name, resolution)
    if name in GARMENTS:
        assert task.body.num_particles == pytest.approx(resolution**2, rel=0.15)
    else:
        assert task.body.shape == (resolution,) * len(task.body.shape)
    assert task.goal.shape == task.body.rest.shape
    simulation = task.simulation()
    assert float(simulation.time_step) == pytest.approx(task.time_step, rel=1e-6)
    seconds = task.action_steps * task.time_step
    assert seconds == pytest.approx(task.action_seconds, abs=task.time_step / 2)  # whole steps


@pytest.mark.parametrize("name", task_names())
def test_scales(name):
    full, quick = make_task(name), make_task(name, quick=True)
    assert quick.body.num_particles < full.body.num_particles
    assert make_task(name, 7, quick=True).body.num_particles < quick.body.num_particles
    assert full.name == name


def test_unknown_task_names_the_choices():
    with pytest.raises(ValueError, match=r"unknown task 'rope_tying'.*rope_folding"):
        make_task("rope_tying")


@pytest.mark.parametrize("resolution", [4, 1, 0, -3])
def test_low_resolution_is_refused(resolution):
    with pytest.raises(ValueError, match=f"resolution is {resolution}; .* at least 5"):
        make_task("rope_folding", resolution)


def test_a_name_is_taken_once(monkeypatch):
    monkeypatch.setattr(tasks.task, "_REGISTRY", dict(tasks.task._REGISTRY))
    with pytest.raises(ValueError, match="'rope_folding' is registered already"):
        tasks.register("rope_folding", full=9, quick=5)
    made = []

    @tasks.register("mine", full=9, quick=6)
    def mine(resolution):
        made.append(resolution)
        return make_task("rope_folding", resolution)

    assert "mine" in task_names()
    for choice in ({}, {"quick": True}, {"resolution": 7}):
        make_task("mine", **choice)
    assert made == [9, 6, 7]
