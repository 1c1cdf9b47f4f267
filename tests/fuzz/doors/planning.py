"""Planning: settings of algorithms, problems, searches, and the planner."""

from typing import Any

import jax
import numpy as np
from hypothesis import strategies as st

import jaxsimp as js
from tests.fuzz.core import Door, Parameter
from tests.fuzz.doors.dynamics import is_plain, is_plan
from tests.fuzz.valid import as_floats, both, in_range, is_array, is_count, is_flag, is_one_of
from tests.fuzz.values import anything, array, choice, count, flag, made, number

TASK = js.make_task("rope_folding", 5)
EPISODE = TASK.episode_fn(0)
SMALL = js.CEM(num_iterations=1, population=4, initial_populations=1)
IDS = np.array([0, 2, 4])
SHAPE = (3, TASK.num_actions, TASK.num_pickers)
PICK = np.zeros(SHAPE, int)
MOVE = 0.02 * np.ones((*SHAPE, 3))
START = np.asarray(EPISODE.start)


class Engines:
    """What takes long to make, made at the first use."""

    planner: js.Planner | None = None
    problem: Any = None

    @classmethod
    def get(cls) -> js.Planner:
        """The planner of `TASK`."""
        cls.planner = cls.planner or js.Planner(TASK, layout=js.Layout(4, 1))
        return cls.planner

    @classmethod
    def get_problem(cls) -> Any:
        """The problem of `TASK`."""
        cls.problem = cls.problem or js.make_problem(TASK, IDS)
        return cls.problem


def _is_cem(**given: Any) -> bool | None:
    ranges = {
        "elite_fraction": ((0.01, 1.0), (1e-300, 1.0)),
        "smoothing": ((0.0, 0.95), (0.0, 1 - 1e-16)),
        "initial_spread": ((0.01, 10.0), (1e-300, 1e9)),
    }
    verdicts = []
    for name, value in given.items():
        if name in ranges:
            verdicts.append(in_range(value, *ranges[name][0], absurd=ranges[name][1]))
        elif name == "keep_best":
            verdicts.append(is_flag(value))
        elif name == "returns":
            verdicts.append(is_one_of(value, ("best", "mean")))
        elif name == "wants":
            verdicts.append(is_one_of(value, ("cost", "screened")))
        elif name == "encoding":
            verdicts.append(isinstance(value, js.Encoding))
        else:
            verdicts.append(is_count(value, 1, 10**4))
    return both(*verdicts)


def _check_cem(cem: js.CEM, **_: Any) -> None:
    hash(cem)
    assert 1 <= cem.num_elites <= cem.population, f"{cem.num_elites} elites"
    assert cem.num_asks >= 1, f"{cem.num_asks} questions"


def _is_descent(num_asks: Any = 35, num_starts: Any = 1, learning_rate: Any = 0.03) -> bool | None:
    return both(
        is_count(num_asks, 1, 10**4),
        is_count(num_starts, 1, 10**4),
        in_range(learning_rate, 1e-6, 1.0, absurd=(1e-300, 1e9)),
    )


def _is_sequence(algorithms: Any) -> bool | None:
    if not isinstance(algorithms, tuple | list):
        return False
    fine = bool(algorithms) and all(isinstance(each, js.Algorithm) for each in algorithms)
    return both(fine, True if isinstance(algorithms, tuple) else None)


def is_candidates(candidates: Any, num_particles: int) -> bool | None:
    """Whether a value is candidates: distinct ids, or a mask."""
    if isinstance(candidates, js.KeyPoints):
        return True
    ids = np.asarray(candidates) if not isinstance(candidates, dict | set) else np.zeros(0)
    if ids.dtype == bool:
        return bool(ids.shape == (num_particles,) and ids.any())
    if ids.dtype.kind not in "iu" or ids.ndim != 1 or not ids.size:
        return False
    fine = ids.min() >= 0 and ids.max() < num_particles and len(np.unique(ids)) == len(ids)
    return bool(fine) and (True if isinstance(candidates, np.ndarray) else None)


def _check_problem(problem: Any, candidates: Any, **_: Any) -> None:
    ids = np.asarray(candidates.particles if isinstance(candidates, js.KeyPoints) else candidates)
    wanted = np.flatnonzero(ids) if ids.dtype == bool else ids
    assert np.array_equal(problem.space.candidates, wanted), "other candidates"


def _candidates() -> Parameter:
    mask = np.zeros(5, bool)
    mask[IDS] = True
    wrong = st.sampled_from(
        (
            [0, 99],
            [-5, 0],
            [0, 0],
            [[0, 2, 4]],
            [0.0, 2.0],
            (),
            np.array([0, 2**40]),
            np.zeros(5, bool),
            np.ones(6, bool),
            np.ones((5, 1), bool),
            np.array([0, 5]),
            np.array([True, False]),
            [True, False, True, False, True],
        )
    )
    points = js.simplify(TASK.body, TASK.goal)
    return Parameter(
        st.sampled_from([IDS, mask, points]), wrong | array(st.just(IDS)).hostile, optional=False
    )


def _plan(candidates: Any = IDS, seed: Any = 0, start: Any = START, goal: Any = None) -> Any:
    goal = EPISODE.goal if goal is None else goal
    return Engines.get().plan(js.Episode(start, goal), candidates, SMALL, seed)


def _is_plan_call(
    candidates: Any = IDS, seed: Any = 0, start: Any = START, goal: Any = None
) -> bool | None:
    places = [is_array(each, (5, 3)) for each in (start, EPISODE.goal if goal is None else goal)]
    if False in places:
        return False
    far = any(
        np.abs(as_floats(each) - START).max() > 3 for each in (start, goal) if each is not None
    )
    return both(
        is_candidates(candidates, 5),
        is_count(seed, 0, 2**31 - 1, most=2**64),
        *places,
        None if far else True,
    )


def _check_plan(plan: js.Plan, candidates: Any = IDS, seed: Any = 0, **_: Any) -> None:
    problem = js.make_problem(TASK, candidates)
    allowed = [*np.asarray(problem.space.candidates).tolist(), -1]
    assert np.isin(np.asarray(plan.actions.pick), allowed).all(), "another particle is picked"
    moves = np.abs(np.asarray(plan.actions.displacement))
    assert (moves <= np.array(TASK.limits) * (1 + 1e-6)).all(), "a displacement is over the limits"
    assert not np.isnan(plan.optimum.cost), "the cost is NaN"


def _costs(pick: Any = PICK, displacement: Any = MOVE, start: Any = START) -> Any:
    return Engines.get().costs(js.Episode(start, EPISODE.goal), js.Actions(pick, displacement))


def _is_costs(pick: Any = PICK, displacement: Any = MOVE, start: Any = START) -> bool | None:
    ids, moves = as_floats(pick), as_floats(displacement)
    place = is_array(start, (5, 3))
    if ids is None or moves is None or place is False or ids.ndim != 3:
        return False
    if ids.shape[1:] != SHAPE[1:] or moves.shape != (*ids.shape, 3):
        return False
    flat = is_plan(np.asarray(pick).reshape(-1, SHAPE[2]), moves.reshape(-1, SHAPE[2], 3), 5)
    far = np.abs(as_floats(start) - START).max() > 0.5
    plain = is_plain(pick) and is_plain(displacement)
    return both(flat, place, True if plain and not far else None)


def _check_costs(costs: Any, pick: Any = PICK, start: Any = START, **_: Any) -> None:
    assert costs.shape == (len(np.asarray(pick)),), f"shape {costs.shape}"
    near = np.abs(as_floats(start) - START).max() < 0.5
    assert not near or np.isfinite(costs).all(), "a cost is not finite"


def _execute(pick: Any = PICK[0], displacement: Any = MOVE[0], start: Any = START) -> Any:
    return Engines.get().execute(js.Episode(start, EPISODE.goal), js.Actions(pick, displacement))


def _is_execute(pick: Any = PICK[0], displacement: Any = MOVE[0], start: Any = START) -> Any:
    place = is_array(start, (5, 3))
    far = place is not False and np.abs(as_floats(start) - START).max() > 0.5
    return both(is_plan(pick, displacement, 5, SHAPE[1:]), place, None if far else True)


def _check_execute(execution: js.Execution, start: Any = START, **_: Any) -> None:
    failed = execution.status == js.ExecutionStatus.UNSTABLE
    assert failed or np.isfinite(execution.positions).all(), "a position is not finite, status FINE"
    assert failed or np.isfinite(execution.score), "the score is not finite, and the status is FINE"


def _optimize(key: Any = None, batch: Any = None) -> Any:
    key = jax.random.key(0) if key is None else key
    return js.optimize(Engines.get_problem(), js.RandomShooting(1, 2), key, batch=batch)


def _is_optimize(key: Any = None, batch: Any = None) -> bool | None:
    keyed = key is None or (
        isinstance(key, jax.Array) and jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key)
    )
    old = str(getattr(key, "dtype", "")) == "uint32" and np.shape(key) == (2,)
    shaped = key is None or np.shape(key) == () or old
    small = True if batch is None else is_count(batch, 1, 100)
    return both((keyed and shaped) or (None if old else False), small)


def _search(value: Any = 1.0) -> Any:
    def evaluate(wants: str, actions: js.Actions) -> Any:
        from jaxsimp.planning import Told

        costs = np.zeros(len(actions.pick)) + value if np.ndim(value) == 0 else value
        return Told(costs)

    space = Engines.get_problem().space
    return js.search_on_host(js.RandomShooting(1, 2), space, jax.random.key(0), evaluate)


def _is_costs_told(value: Any = 1.0) -> bool | None:
    told = as_floats(value)
    if told is None or told.shape not in ((), (2,)):
        return False
    return None  # costs that are not finite count as failed


def _check_search(found: Any, value: Any = 1.0) -> None:
    assert not np.isnan(found.cost), "the cost is NaN"
    failed = 0 if np.isfinite(as_floats(value)).all() else 1
    assert int(found.failed) >= failed, "a failure is not counted"


algorithms = (SMALL, js.RandomShooting(), js.Descent(), js.Reranking())
COSTS = (
    lambda: np.nan,
    lambda: np.inf,
    lambda: -np.inf,
    lambda: 1e300,
    lambda: np.array([np.nan, 1.0]),
    lambda: np.ones(3),
    lambda: np.ones((2, 1)),
    lambda: np.array([1, 2]),
    lambda: np.array([1j, 2.0]),
    lambda: np.array(["a", "b"]),
)
KEYS = (
    lambda: jax.random.split(jax.random.key(0), 2),
    lambda: jax.random.PRNGKey(0),
    lambda: 3,
    lambda: np.zeros(2, np.uint32),
)

DOORS = (
    Door(
        "planning.CEM",
        js.CEM,
        {
            "num_iterations": count(1, 30),
            "population": count(1, 200),
            "initial_populations": count(1, 5),
            "elite_fraction": number(0.02, 1.0),
            "smoothing": number(0.0, 0.9),
            "initial_spread": number(0.1, 2.0),
            "keep_best": flag(),
            "returns": choice("best", "mean"),
            "wants": choice("cost", "screened"),
            "encoding": Parameter(st.sampled_from(list(js.ENCODINGS.values())), anything),
        },
        _is_cem,
        _check_cem,
        weight=20,
    ),
    Door(
        "planning.RandomShooting",
        js.RandomShooting,
        {"num_asks": count(1, 30), "num_plans": count(1, 200)},
        lambda **given: both(*(is_count(each, 1, 10**4) for each in given.values())),
    ),
    Door(
        "planning.Descent",
        js.Descent,
        {
            "num_asks": count(1, 30),
            "num_starts": count(1, 9),
            "learning_rate": number(1e-3, 0.5),
        },
        _is_descent,
    ),
    Door(
        "planning.Reranking",
        js.Reranking,
        {"num_starts": count(1, 30)},
        lambda num_starts=8: is_count(num_starts, 1, 10**4),
        weight=5,
    ),
    Door(
        "planning.LocalSearch",
        js.LocalSearch,
        {
            "num_plans": count(8, 30),
            "num_starts": count(1, 8),
            "wants": choice("settled", "cost"),
        },
        lambda num_plans=8, num_starts=1, wants="settled": both(
            is_count(num_plans, 1, 10**4),
            is_count(num_starts, 1, 10**4),
            is_one_of(wants, ("settled", "cost")),
            None if is_count(num_starts, 2, 10**4) is not False else True,
        ),
    ),
    Door(
        "planning.Joint",
        js.Joint,
        {"borrowed": number(0.1, 5.0), "fresh": number(0.0, 1.0)},
        lambda borrowed=0.5, fresh=0.05: both(
            in_range(borrowed, 0.1, 10.0, absurd=(0.0, 1e9)),
            in_range(fresh, 0.0, 1.0, absurd=(0.0, 1.0)),
        ),
    ),
    Door(
        "planning.Sequence",
        js.Sequence,
        {
            "algorithms": Parameter(
                st.lists(st.sampled_from(algorithms), min_size=1, max_size=3).map(tuple),
                st.lists(st.sampled_from(algorithms) | anything, max_size=2).map(tuple)
                | st.just(SMALL)
                | anything,
                optional=False,
            )
        },
        _is_sequence,
        weight=5,
    ),
    Door(
        "planning.make_problem",
        lambda candidates: js.make_problem(TASK, candidates),
        {"candidates": _candidates()},
        lambda candidates: is_candidates(candidates, 5),
        _check_problem,
    ),
    Door(
        "planning.Planner.plan",
        _plan,
        {
            "candidates": _candidates(),
            "seed": count(0, 1000),
            "start": array(st.just(START), optional=True),
            "goal": array(st.just(np.asarray(EPISODE.goal)), optional=True),
        },
        _is_plan_call,
        _check_plan,
        weight=8,
        prepare=_plan,
    ),
    Door(
        "planning.Planner.costs",
        _costs,
        {
            "pick": array(st.just(PICK), optional=True),
            "displacement": array(st.just(MOVE), optional=True),
            "start": array(st.just(START), optional=True),
        },
        _is_costs,
        _check_costs,
        weight=8,
        prepare=_costs,
    ),
    Door(
        "planning.Planner.execute",
        _execute,
        {
            "pick": array(st.just(PICK[0]), optional=True),
            "displacement": array(st.just(MOVE[0]), optional=True),
            "start": array(st.just(START), optional=True),
        },
        _is_execute,
        _check_execute,
        weight=8,
        prepare=_execute,
    ),
    Door(
        "planning.optimize",
        _optimize,
        {
            "key": Parameter(st.just(None), made(KEYS) | anything),
            "batch": Parameter(st.sampled_from((None, 1, 2)), anything),
        },
        _is_optimize,
        weight=2,
        prepare=_optimize,
    ),
    Door(
        "planning.search_on_host",
        _search,
        {"value": Parameter(st.just(1.0), made(COSTS))},
        _is_costs_told,
        _check_search,
        weight=4,
    ),
)
