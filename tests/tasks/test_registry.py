"""The registry: groups, scales, names that are taken or unknown."""

import dataclasses

import pytest

from jaxsimp.tasks import make_task, register, registry, task_names

ROPES = ("rope_straightening", "rope_folding")
FOLDS = ("cloth_side_folding", "cloth_diagonal_folding")
GARMENTS = ("t_shirt_sleeves_in", "trousers_leg_over_leg")


def test_the_four_tasks_of_the_paper_are_registered():
    assert set(task_names("paper")) == {*ROPES, *FOLDS}


def test_groups_are_all_tasks():
    groups = ("paper", "goals", "obstacles", "folded")
    assert set(task_names()) == {name for group in groups for name in task_names(group)}
    assert len(task_names("goals")) == 8
    assert task_names("obstacles") == ("towel_over_bar",)
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
    assert full.name == quick.name == name
    assert full.resolution > quick.resolution


def test_unknown_task_names_the_choices():
    with pytest.raises(ValueError, match=r"unknown task 'rope_tying'.*rope_folding"):
        make_task("rope_tying")


@pytest.mark.parametrize("resolution", [4, 1, 0, -3])
def test_low_resolution_is_refused(resolution):
    with pytest.raises(ValueError, match=f"resolution is {resolution}; give a whole number from 5"):
        make_task("rope_folding", resolution)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("resolution", [7.5, "9"])
def test_a_resolution_that_is_no_whole_number_is_refused(resolution):
    with pytest.raises(ValueError, match=f"resolution is {resolution!r}; give a whole number"):
        make_task("rope_folding", resolution)


@pytest.fixture
def own_registry(monkeypatch):
    """A registry that forgets, after the test, what the test registers."""
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))


def test_a_name_is_taken_once(own_registry):
    def rope_folding(resolution):
        return make_task("rope_letter_m", resolution)

    with pytest.raises(ValueError, match="'rope_folding' is registered already"):
        register(full=9, quick=5)(rope_folding)
    assert make_task("rope_folding", 9).num_actions == 4  # the one registered first


def test_a_task_of_ones_own_is_made_at_its_full_and_quick_resolution(own_registry):
    made = []

    @register(full=9, quick=6)
    def mine(resolution):
        made.append(resolution)
        return make_task("rope_folding", resolution)

    assert "mine" in task_names()
    for choice in ({}, {"quick": True}, {"resolution": 7}):
        make_task("mine", **choice)
    assert made == [9, 6, 7]


def test_a_registered_task_has_the_name_of_its_factory_and_its_resolution(own_registry):
    @register(full=9, quick=6)
    def mine(resolution):
        """Documented."""
        return dataclasses.replace(make_task("rope_folding", resolution), name="another")

    for task, resolution in [(make_task("mine", quick=True), 6), (mine(8), 8)]:
        assert (task.name, task.resolution) == ("mine", resolution)
    assert mine.__doc__ == "Documented."
    assert dataclasses.replace(make_task("rope_folding", 9), num_actions=2).name == "rope_folding"


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_scale_is_true_or_false_and_a_group_a_name():
    with pytest.raises(ValueError, match="quick is 'no'; give True or False"):
        make_task("rope_folding", quick="no")
    with pytest.raises(ValueError, match="group is 3; give the name of one"):
        task_names(3)
