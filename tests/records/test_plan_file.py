"""Plan files: what is read is what was written, and stands alone."""

import dataclasses
import functools
import io
import json
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsimp import goals
from jaxsimp.bodies import t_shirt
from jaxsimp.dynamics import Actions, Box, Capsule, Sphere, Table
from jaxsimp.engines import Execution, ExecutionStatus, MassSprings
from jaxsimp.records import SavedPlan, load_plan, plan_file, save_plan
from jaxsimp.tasks import Episode, FixedStart, Task, distance_cost, make_task, score


@functools.cache
def rope_task() -> Task:
    """A registered task with other numbers and another material, which the file must keep."""
    task = make_task("rope_folding", 9)
    return dataclasses.replace(
        task,
        body=task.body.scaled(drag=3.0),
        num_actions=1,
        action_seconds=0.05,
        settle_actions=1,
        longest_time_step=1e-3,
    )


PLAN = Actions(jnp.array([[0, 8]]), jnp.full((1, 2, 3), 0.05))


@functools.cache
def executed() -> Execution:
    return MassSprings().executor(rope_task())(rope_task().episode_fn(0), PLAN)


def write(path: Path, execution: Execution | None = None) -> None:
    save_plan(
        path,
        rope_task(),
        rope_task().episode_fn(0),
        PLAN,
        execution or executed(),
        engine=MassSprings(),
        found={"seed": 3},
    )


def test_a_file_holds_what_was_written(tmp_path):
    write(tmp_path / "plan.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]
    found, episode = load_plan(str(tmp_path / "plan.npz")), rope_task().episode_fn(0)
    np.testing.assert_array_equal(found.actions.pick, PLAN.pick)
    np.testing.assert_array_equal(found.actions.displacement, PLAN.displacement)
    np.testing.assert_array_equal(found.positions, executed().positions)
    np.testing.assert_array_equal(found.episode.start, episode.start)
    np.testing.assert_array_equal(found.episode.goal, episode.goal)
    assert found.about["score"] == executed().score
    assert found.about["engine"] == "MassSprings(self_contact=False)"
    assert found.about["status"] == "FINE"
    assert found.about["found"] == {"seed": 3}
    assert found.about["environment"]["versions"]["jaxsimp"]
    assert found.about["task"]["name"] == "rope_folding"


def test_a_file_keeps_the_obstacles(tmp_path):
    kept = (Capsule((0.0, 0, 1), (0.0, 1, 1), 0.2), Box((0.0, 0, 0), (0.3, 0.3, 0.3)), Table())
    body = rope_task().body
    for task in (
        dataclasses.replace(rope_task(), obstacles=kept),
        dataclasses.replace(rope_task(), obstacles=kept, name="mine", resolution=None),
    ):
        path = tmp_path / "plan.npz"
        save_plan(path, task, task.episode_fn(0), PLAN, executed(), engine=MassSprings())
        found = load_plan(path).task()
        for one, other in zip(found.obstacles, kept, strict=True):
            assert type(one) is type(other)
            for name, number in vars(other).items():
                np.testing.assert_array_equal(getattr(one, name), number)
        assert len(found.simulation().obstacles) == 3
        assert found.body.num_particles == body.num_particles


def test_an_obstacle_of_another_shape_is_not_read(tmp_path):
    class Ball(Sphere):
        pass

    task = dataclasses.replace(rope_task(), obstacles=(Ball((0.0, 0.0, 0.0), 0.1),))
    path = tmp_path / "plan.npz"
    save_plan(path, task, task.episode_fn(0), PLAN, executed(), engine=MassSprings())
    with pytest.raises(
        ValueError, match=r"obstacle of the shape 'Ball'; files are read with Table"
    ):
        load_plan(path).task()


def assert_same_body(found: SavedPlan, body) -> None:
    for field in dataclasses.fields(body):
        wanted, value = getattr(body, field.name), getattr(found.body, field.name)
        np.testing.assert_array_equal(value, wanted, err_msg=field.name)
        assert type(value) is type(wanted)


def test_a_body_comes_back_whole(tmp_path):
    write(tmp_path / "plan.npz")
    assert_same_body(load_plan(tmp_path / "plan.npz"), rope_task().body)


def test_the_task_of_a_file_repeats_the_execution_bit_for_bit(tmp_path):
    write(tmp_path / "plan.npz")
    found = load_plan(tmp_path / "plan.npz")
    task = found.task()
    assert (task.name, task.limits, task.num_actions) == ("rope_folding", rope_task().limits, 1)
    assert (task.time_step, task.action_steps) == (rope_task().time_step, rope_task().action_steps)
    again = MassSprings().executor(task)(found.episode, found.actions)
    np.testing.assert_array_equal(again.positions, executed().positions)
    assert again.score == executed().score


def test_a_plan_of_an_own_task_stands_alone(tmp_path):
    # The file is read in a process that never saw the task: its score is by mean distance.
    shirt = t_shirt(num_particles=60).body
    goal = goals.turn(goals.flat(shirt), 0.3)
    episode = Episode(goals.flat(shirt), goal)
    own = Task(
        body=shirt,
        goal=goal,
        episode_fn=FixedStart(episode),
        running_cost=lambda episode, state, action: distance_cost(episode, state),
        terminal_cost=lambda episode, state: distance_cost(episode, state) ** 2,
        limits=(0.1, 0.1, 0.1),
        num_actions=1,
        name="my_own",
    )
    positions = np.stack([goals.flat(shirt)] * 2 + [goals.turn(goals.flat(shirt), 0.1)])
    execution = Execution(positions, 0.5)
    path = tmp_path / "plan.npz"
    save_plan(path, own, episode, PLAN, execution, engine="mine")
    assert_same_body(load_plan(path), shirt)
    code = (
        "import sys, jaxsimp as js; plan = js.load_plan(sys.argv[1]); task = plan.task(); "
        "print(task.name, float(js.score(task, plan.episode, plan.positions[-1])))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    name, value = done.stdout.split()
    # Distances of a turn are in proportion to the sine of half the angle left.
    wanted = 1 - np.sin(0.1) / np.sin(0.15)
    assert name == "my_own"
    assert float(value) == pytest.approx(wanted, abs=1e-5)  # float32 of positions of 0.5 m
    assert float(score(own, episode, positions[-1])) != pytest.approx(wanted, abs=0.01)


def test_a_plan_that_failed_is_kept_as_one(tmp_path):
    failed = Execution(np.full((3, 9, 3), np.nan), float("nan"), ExecutionStatus.UNSTABLE)
    write(tmp_path / "plan.npz", failed)
    about = load_plan(tmp_path / "plan.npz").about
    assert (about["score"], about["status"]) == (None, "UNSTABLE")


def old_file(path: Path) -> None:
    """As version 0.1 wrote it."""
    np.savez_compressed(
        path, pick=PLAN.pick, displacement=PLAN.displacement, positions=executed().positions
    )


def test_files_of_version_0_1_are_read(tmp_path):
    old_file(tmp_path / "plan.npz")
    found = load_plan(tmp_path / "plan.npz")
    np.testing.assert_array_equal(found.actions.displacement, PLAN.displacement)
    np.testing.assert_array_equal(found.positions, executed().positions)
    assert found.body is None
    with pytest.raises(ValueError, match=r"version 0\.1.*make_task"):
        found.task()


def test_a_save_that_fails_leaves_the_old_plan(tmp_path, monkeypatch):
    path = tmp_path / "plan.npz"
    write(path)
    before = path.read_bytes()

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:10])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for name in ("plan.npz", "new.npz"):
        with pytest.raises(OSError, match="no space"):
            write(tmp_path / name)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["plan.npz"]


def broken_files() -> dict[str, bytes]:
    other, single = io.BytesIO(), io.BytesIO()
    np.savez(other, pick=np.zeros((1, 2), int))
    np.save(single, np.zeros(3))
    return {
        "garbage": b"not a plan at all",
        "nothing": b"",
        "another archive": other.getvalue(),
        "one array": single.getvalue(),
    }


@pytest.mark.parametrize("content", broken_files().values(), ids=broken_files())
def test_a_file_that_is_no_plan_is_refused_by_name(tmp_path, content):
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


@pytest.mark.parametrize("part", [0.3, 0.9])
def test_a_plan_cut_short_is_refused_by_name(tmp_path, part):
    path = tmp_path / "plan.npz"
    write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ValueError, match=r"plan\.npz .*not a saved plan"):
        load_plan(path)


@pytest.mark.parametrize("about", ["no json", "{}", json.dumps({"body": {}})])
def test_a_damaged_description_is_refused_by_name(tmp_path, about):
    write(tmp_path / "plan.npz")
    arrays = dict(np.load(tmp_path / "plan.npz"))
    np.savez(tmp_path / "damaged.npz", **arrays | {"about": about})
    with pytest.raises(ValueError, match=r"damaged\.npz is damaged"):
        load_plan(tmp_path / "damaged.npz")


def test_a_plan_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"plan\.npz"):
        load_plan(tmp_path / "plan.npz")


def rewritten(path: Path, **changed) -> Path:
    """The file with other arrays; None leaves one out."""
    write(path)
    arrays = dict(np.load(path)) | changed
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"pick": np.array([[0, 9]])}, r"pick\[0, 1\] is 9; a body of 9 particles"),
        ({"pick": np.array([[2**40, 0]])}, rf"pick\[0, 0\] is {2**40}; a body of 9"),
        ({"pick": np.array([[0.5, 0.0]])}, "pick is an array of float64"),
        ({"displacement": np.zeros((1, 1, 3))}, r"give shapes \(T, G\)"),
        ({"displacement": np.full((1, 2, 3), np.nan)}, "is nan; give numbers"),
        ({"positions": np.zeros((2, 9, 3))}, r"shape \(2, 9, 3\); give shape \(3, 9, 3\)"),
        ({"positions": np.zeros(3)}, r"a body of 0 particles|shape \(3,\)"),
        ({"start": np.zeros((8, 3))}, r"start of the episode has shape \(8, 3\)"),
        ({"start": None}, "KeyError: has no 'start'"),
        ({"body/mass": np.zeros(3)}, "mass has shape"),
        ({"about": "[1, 2]"}, "about is no description"),
        ({"about": json.dumps({"body": []})}, "about is no description"),
        ({"about": "[" * 100_000}, "RecursionError"),
    ],
)
def test_arrays_that_are_no_plan_are_refused_by_name(tmp_path, changed, message):
    path = rewritten(tmp_path / "plan.npz", **changed)
    with pytest.raises(ValueError, match=rf"plan\.npz is damaged .*({message})"):
        load_plan(path)


def test_a_file_of_pickles_is_refused_and_nothing_of_it_runs(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "plan.npz"
    np.savez(path, pick=np.array([Evil()]), displacement=np.zeros(1), positions=np.zeros(1))
    with pytest.raises(ValueError, match=r"plan\.npz cannot be read \(.*pickle.*not a saved plan"):
        load_plan(path)
    assert not (tmp_path / "ran").exists()


def test_a_file_that_unpacks_to_more_than_memory_is_refused_before_it_is(tmp_path, monkeypatch):
    path = tmp_path / "plan.npz"
    write(path)
    monkeypatch.setattr(plan_file, "MOST_BYTES", 1000)
    with pytest.raises(ValueError, match=r"it unpacks to [\d,]+ bytes, and 1,000 are allowed"):
        load_plan(path)


@pytest.mark.usefixtures("unchecked_shapes")
def test_what_is_no_plan_of_the_task_is_not_saved(tmp_path):
    task, episode = rope_task(), rope_task().episode_fn(0)
    other = Episode(episode.start[:4], episode.goal)
    long = Execution(np.zeros((5, 9, 3)), 0.5)
    far = Actions(np.array([[0, 9]]), PLAN.displacement)
    for arguments, message in (
        ((episode, far, executed()), "is 9; a body of 9"),
        ((other, PLAN, executed()), r"start of the episode has shape \(4, 3\)"),
        ((episode, PLAN, long), r"shape \(5, 9, 3\); give shape \(3, 9, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            save_plan(str(tmp_path / "plan.npz"), task, *arguments, engine="mine")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_task_is_told(tmp_path):
    write(tmp_path / "plan.npz")
    about = json.loads(str(np.load(tmp_path / "plan.npz")["about"]))
    del about["task"]["limits"]
    path = rewritten(tmp_path / "plan.npz", about=json.dumps(about))
    with pytest.raises(ValueError, match=r"of the task is damaged \(KeyError: 'limits'"):
        load_plan(path).task()


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"found": 3}, "found is 3; give a dictionary"),
        ({"found": {1j: 1}}, "found is .*, and no JSON .*; give numbers, texts"),
        ({"found": {"cost": np.float32(1)}}, r"no JSON \(Object of type float32"),
        ({"score": {}}, "the score of the execution is {}; give one real number"),
        ({"score": np.ones(2)}, "the score of the execution is array.*; give one real number"),
    ],
)
def test_what_a_file_cannot_hold_is_not_saved(tmp_path, changed, message):
    execution = dataclasses.replace(
        executed(), **{k: v for k, v in changed.items() if k == "score"}
    )
    with pytest.raises(ValueError, match=message):
        save_plan(
            tmp_path / "plan.npz",
            rope_task(),
            rope_task().episode_fn(0),
            PLAN,
            execution,
            engine="mine",
            found=changed.get("found"),
        )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("unchecked_shapes")
def test_other_bytes_and_a_score_of_jax_are_saved_as_they_are(tmp_path):
    moves = np.asarray(PLAN.displacement)
    other = Actions(np.asarray(PLAN.pick), moves.astype(moves.dtype.newbyteorder()))
    execution = dataclasses.replace(executed(), score=jnp.asarray(0.5))
    path = tmp_path / "plan.npz"
    save_plan(path, rope_task(), rope_task().episode_fn(0), other, execution, engine="mine")
    found = load_plan(path)
    np.testing.assert_array_equal(found.actions.displacement, moves)
    assert found.about["score"] == 0.5


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_name_that_is_no_text_is_no_task(tmp_path):
    path = tmp_path / "plan.npz"
    write(path)
    about = json.loads(str(np.load(path)["about"]))
    about["task"]["name"] = 3
    with pytest.raises(ValueError, match="name is 3; give a text"):
        load_plan(rewritten(path, about=json.dumps(about))).task()


def test_a_folder_is_no_plan(tmp_path):
    with pytest.raises(IsADirectoryError, match="give a file of save_plan"):
        load_plan(tmp_path)
