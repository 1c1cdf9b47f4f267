"""Planning: from a task and candidates, the particles that a picker may grasp, to a plan.

A *problem* gives the cost of plans; an *algorithm*, one file each, asks for costs and is told them;
`optimize` and `Planner` run algorithms on problems.
"""

from jaxsimp.planning.algorithm import PRICES, Algorithm, Defaults, Sequence, Told, Wants, price
from jaxsimp.planning.archive import Archive
from jaxsimp.planning.between_bodies import carry_over
from jaxsimp.planning.cem import CEM
from jaxsimp.planning.coarse_to_fine import CoarseToFinePlanner
from jaxsimp.planning.default import default_algorithm
from jaxsimp.planning.descent import Descent
from jaxsimp.planning.encodings import ENCODINGS, Categorical, Encoding, GaussianIndex, Joint
from jaxsimp.planning.host import search_on_host
from jaxsimp.planning.local_search import LocalSearch
from jaxsimp.planning.loop import Optimum, optimize
from jaxsimp.planning.plan import Plan
from jaxsimp.planning.planner import Planner
from jaxsimp.planning.problem import Candidates, Problem, TaskProblem, action_space, make_problem
from jaxsimp.planning.random_shooting import RandomShooting
from jaxsimp.planning.reranking import Reranking
from jaxsimp.planning.space import ActionSpace, Plans
from jaxsimp.planning.stages import (
    StagedPlanner,
    num_stages,
    planner_of,
    stage_algorithm,
    staged_task,
    stages_of,
)

__all__ = [
    "CEM",
    "ENCODINGS",
    "PRICES",
    "ActionSpace",
    "Algorithm",
    "Archive",
    "Candidates",
    "Categorical",
    "CoarseToFinePlanner",
    "Defaults",
    "Descent",
    "Encoding",
    "GaussianIndex",
    "Joint",
    "LocalSearch",
    "Optimum",
    "Plan",
    "Planner",
    "Plans",
    "Problem",
    "RandomShooting",
    "Reranking",
    "Sequence",
    "StagedPlanner",
    "TaskProblem",
    "Told",
    "Wants",
    "action_space",
    "carry_over",
    "default_algorithm",
    "make_problem",
    "num_stages",
    "optimize",
    "planner_of",
    "price",
    "search_on_host",
    "stage_algorithm",
    "staged_task",
    "stages_of",
]
