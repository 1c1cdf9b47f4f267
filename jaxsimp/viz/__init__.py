"""Views of bodies, models, searches and plans: figures for papers, moving pages, videos."""

from jaxsimp.viz.animation import animate
from jaxsimp.viz.figures import (
    COLORS,
    GOAL_COLOR,
    OBSTACLE_COLOR,
    draw_body,
    draw_obstacle,
    mean_interval,
    plot_costs,
    plot_executions,
    plot_model_errors,
    plot_models,
    plot_scores,
    plot_simplifications,
)
from jaxsimp.viz.scene import Scene, make_scene, scene_of_goal, scene_of_plan

__all__ = [
    "COLORS",
    "GOAL_COLOR",
    "OBSTACLE_COLOR",
    "Scene",
    "animate",
    "draw_body",
    "draw_obstacle",
    "make_scene",
    "mean_interval",
    "plot_costs",
    "plot_executions",
    "plot_model_errors",
    "plot_models",
    "plot_scores",
    "plot_simplifications",
    "scene_of_goal",
    "scene_of_plan",
]
