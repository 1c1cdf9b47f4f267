"""Tasks of garments."""

from jaxsimp import goals
from jaxsimp.bodies import garments
from jaxsimp.tasks.cloth import flat_task
from jaxsimp.tasks.registry import register
from jaxsimp.tasks.task import Task


@register(full=25, quick=15, group="goals")
def t_shirt_sleeves_in(resolution: int) -> Task:
    """Turn both sleeves of a T-shirt in."""
    shirt = garments.t_shirt(num_particles=resolution**2)
    goal = goals.fold_sequence(shirt.body, goals.sleeves_in(shirt))
    return flat_task(shirt.body, goal, num_actions=3)


@register(full=25, quick=15, group="goals")
def trousers_leg_over_leg(resolution: int) -> Task:
    """Turn one leg of a pair of trousers over onto the other."""
    trousers = garments.trousers(num_particles=resolution**2)
    goal = goals.fold_sequence(trousers.body, goals.leg_over_leg(trousers))
    return flat_task(trousers.body, goal, num_actions=3)
