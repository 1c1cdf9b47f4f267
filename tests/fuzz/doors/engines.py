"""Engines: ensembles, layouts, models of MuJoCo and MJX, replays."""

from contextlib import chdir
from typing import Any

import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from jaxsimp.engines import default_layout
from jaxsimp.engines.mujoco import Variant
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.dynamics import are_obstacles, broken, is_plan, whole
from tests.fuzz.files import FOLDER
from tests.fuzz.valid import both, in_range, is_array, is_count, is_flag, is_one_of
from tests.fuzz.values import (
    anything,
    array,
    choice,
    count,
    flag,
    number,
)

TASK = js.make_task("rope_folding", 5)
EPISODE = TASK.episode_fn(0)
SPREAD = ("stiffness", "damping", "drag", "friction", "mass", "time_step")
PICK = np.zeros((TASK.num_actions, TASK.num_pickers), int)
MOVE = 0.02 * np.ones((*PICK.shape, 3))


def _is_spread(**given: Any) -> bool | None:
    return both(*(in_range(each, 1.0, 3.0, absurd=(1.0, 1e9)) for each in given.values()))


def _is_ensemble(
    size: Any = 5,
    seed: Any = 0,
    statistic: Any = "mean",
    caution: Any = 0.0,
    self_contact: Any = False,
    spread: Any = None,
) -> bool | None:
    careful = in_range(caution, 0.0, 10.0, absurd=(0.0, 1e9))
    worst = statistic == "worst" if isinstance(statistic, str) else False
    return both(
        is_count(size, 1, 20, most=10**5),
        is_count(seed, 0, 10**6, most=2**64),
        is_one_of(statistic, ("mean", "worst")),
        careful,
        not (worst and careful is not False and float(caution) > 0),
        is_flag(self_contact),
        None if spread is not None and not isinstance(spread, js.Spread) else True,
    )


def _check_ensemble(ensemble: js.Ensemble, size: Any = 5, **_: Any) -> None:
    assert len(ensemble) == int(size), f"{len(ensemble)} members for {size}"
    assert np.isfinite(ensemble.factors).all(), "a factor is not finite"
    assert (ensemble.factors[0] == 1).all(), "the first member is not the body itself"


def _odd_bodies() -> st.SearchStrategy[js.Body]:
    triangle = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0]])
    makers = (
        lambda: js.rope(5),
        lambda: js.rope(2),
        lambda: js.rope(3, bend_stiffness=0.0),
        lambda: js.rope(5, stretch_stiffness=0.0, bend_stiffness=0.0),
        lambda: js.rope(5, thickness=0.0),
        lambda: js.rope(5, friction=0.0, drag=0.0, damping=0.0),
        lambda: js.rope(5, mass=1e3),
        lambda: js.rope(5, mass=1e-6),
        lambda: js.rope(5, stretch_stiffness=1e6),
        lambda: js.rope(5, drag=1e6),
        lambda: js.rope_along(np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0.1]])),
        lambda: js.cloth((4, 4)),
        lambda: js.cloth((2, 2)),
        lambda: js.cloth((4, 4), bend_stiffness=0.0),
        lambda: js.cloth((4, 4), stretch_stiffness=0.0, shear_stiffness=0.0, bend_stiffness=0.0),
        lambda: js.cloth((4, 4), thickness=0.0),
        lambda: js.cloth((4, 4), (0.02, 0.02)),
        lambda: js.from_mesh(triangle, np.array([[0, 1, 2]])),
        lambda: js.from_mesh(triangle, np.array([[0, 1, 2]]), bend_stiffness=0.0),
        lambda: js.t_shirt(num_particles=200, sheets=2).body,
    )
    bodies = []
    for maker in makers:
        try:
            bodies.append(maker())
        except ValueError:  # a body that the constructors refuse has no model
            continue
    return st.sampled_from(bodies)


def _is_model(
    body: js.Body, variant: Any = "full", graspable: Any = (), obstacles: Any = ()
) -> bool | None:
    named = isinstance(variant, Variant) or is_one_of(variant, ("fast", "full"))
    try:
        ids = list(graspable)
    except TypeError:
        return False
    fine = [
        isinstance(each, int | np.integer)
        and not isinstance(each, bool)
        and 0 <= each < body.num_particles
        for each in ids
    ]
    return both(named, all(fine), are_obstacles(obstacles), None)


def _check_model(model: Any, body: js.Body, **_: Any) -> None:
    import mujoco

    total = float(np.sum(model.body_mass))
    assert np.isclose(total, body.mass.sum(), rtol=1e-6), f"the model has {total:g} kg"
    data = mujoco.MjData(model)
    for _step in range(3):
        mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all(), "the model is not finite after three steps"


def _is_variant(time_step: Any, elastic: Any = True, self_collision: Any = True) -> bool | None:
    return both(
        in_range(time_step, 1e-4, 1e-2, absurd=(1e-12, 1e3)),
        is_flag(elastic),
        is_flag(self_collision),
    )


def _layout(population: Any, chunk_size: Any) -> Any:
    return default_layout(population, chunk_size)


def _replay(
    pick: Any = PICK,
    displacement: Any = MOVE,
    start: Any = EPISODE.start,
    variant: Any = "fast",
    num_workers: Any = 1,
) -> Any:
    episode, plan = js.Episode(start, EPISODE.goal), js.Actions(pick, displacement)
    return list(js.replay(TASK, [episode], [plan], variant, num_workers=num_workers))


def _is_replay(
    pick: Any = PICK,
    displacement: Any = MOVE,
    start: Any = EPISODE.start,
    variant: Any = "fast",
    num_workers: Any = 1,
) -> bool | None:
    place = is_array(start, (5, 3))
    return both(
        is_plan(pick, displacement, 5),
        place,
        is_one_of(variant, ("fast", "full")),
        True if num_workers is None else is_count(num_workers, 1, 4, most=10**4),
        None,
    )


def _check_replay(result: Any, **_: Any) -> None:
    (found,) = result
    fine = found.status != js.ExecutionStatus.UNSTABLE
    assert not fine or np.isfinite(found.positions).all(), "a position is not finite"
    assert not fine or np.isfinite(found.score), "the score is not finite"


def _save(path: Any, position: Any = None) -> Any:
    with chdir(FOLDER):  # names such as "nan" are files there
        js.save_mjcf(path, TASK.body, position=position)
    return path


def _paths() -> Parameter:
    good = st.sampled_from([FOLDER / "model.xml", str(FOLDER / "model.xml")])
    bad = st.sampled_from([FOLDER / "no" / "folder.xml", FOLDER, "", "\0", "x" * 5000])
    return Parameter(good, bad | anything, optional=False)


def _is_place(position: Any) -> bool | None:
    """Positions of the body; beyond 1e6 m either will do."""
    verdict = is_array(position, (5, 3))
    return None if verdict and np.abs(np.asarray(position)).max() > 1e6 else verdict


def _is_path(path: Any) -> bool | None:
    FOLDER.mkdir(exist_ok=True)
    if not isinstance(path, str) and not hasattr(path, "__fspath__"):
        return False
    return True if str(path).endswith("model.xml") else None


def _compare(position: Any, num_steps: Any, gravity: Any = 9.81) -> Any:
    return js.compare_with_mjx(TASK.body, js.at_rest(position), num_steps, gravity=gravity)


HIGH = TASK.body.rest + np.array([0.0, 0.0, 0.5])

DOORS = (
    Door("engines.Spread", js.Spread, {n: number(1.0, 3.0) for n in SPREAD}, _is_spread),
    Door(
        "engines.make_ensemble",
        lambda **given: js.make_ensemble(TASK, **given),
        {
            "size": count(1, 4),
            "seed": count(0, 1000),
            "statistic": choice("mean", "worst"),
            "caution": number(0.0, 2.0),
            "self_contact": flag(),
            "spread": Parameter(st.just(js.Spread(time_step=1.0)), anything),
        },
        _is_ensemble,
        _check_ensemble,
        weight=6,
    ),
    Door(
        "engines.Layout",
        js.Layout,
        {"chunk_size": count(1, 64), "num_workers": count(1, 8)},
        lambda **given: both(*(is_count(each, 1, 64) for each in given.values())),
    ),
    Door(
        "engines.mujoco.Variant",
        Variant,
        {
            "time_step": number(5e-4, 5e-3, optional=False),
            "elastic": flag(optional=False),
            "self_collision": flag(optional=False),
        },
        _is_variant,
    ),
    Door(
        "engines.make_model",
        js.make_model,
        {
            "body": Parameter(_odd_bodies(), _odd_bodies(), False),
            "variant": choice("fast", "full"),
            "graspable": Parameter(
                st.just((0, 1)), st.lists(anything | st.integers(-9, 9), max_size=2) | anything
            ),
            "obstacles": Parameter(
                st.lists(whole, max_size=1), st.lists(broken, max_size=1) | anything
            ),
        },
        _is_model,
        _check_model,
        weight=15,
    ),
    Door(
        "engines.save_mjcf",
        _save,
        {"path": _paths(), "position": array(st.just(TASK.body.rest), optional=True)},
        lambda path, position=None: both(
            _is_path(path), True if position is None else _is_place(position)
        ),
        weight=5,
    ),
    Door(
        "engines.MuJoCo",
        lambda variant: js.MuJoCo(variant).executor(TASK),
        {"variant": choice("fast", "full", optional=False)},
        lambda variant: isinstance(variant, Variant) or is_one_of(variant, ("fast", "full")),
        weight=4,
    ),
    Door(
        "engines.MassSprings",
        lambda self_contact: js.MassSprings(self_contact).physics(TASK),
        {"self_contact": flag(optional=False)},
        lambda self_contact: is_flag(self_contact),
        weight=3,
    ),
    Door(
        "engines.replay",
        _replay,
        {
            "pick": array(st.just(PICK), optional=True),
            "displacement": array(st.just(MOVE), optional=True),
            "start": array(st.just(np.asarray(EPISODE.start)), optional=True),
            "variant": choice("fast", "full"),
            "num_workers": count(1, 2),
        },
        _is_replay,
        _check_replay,
        weight=5,
    ),
    Door(
        "engines.compare_with_mjx",
        _compare,
        {
            "position": array(st.just(HIGH)),
            "num_steps": Parameter(st.just(2), anything, optional=False),
            "gravity": number(1.0, 20.0),
        },
        lambda position, num_steps, gravity=9.81: both(
            is_array(position, (5, 3)),
            is_count(num_steps, 1, 100),
            in_range(gravity, 0.0, 100.0, absurd=(-1e9, 1e9)),
            None,
        ),
        weight=1,
        prepare=lambda: _compare(HIGH, 2),
    ),
)
