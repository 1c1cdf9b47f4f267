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
from jaxsimp.viz.meshes import save_frames, save_mesh
from jaxsimp.viz.scene import (
    Scene,
    at_time,
    make_scene,
    past_paths,
    scene_of_goal,
    scene_of_plan,
)
from jaxsimp.viz.video import write_video
from jaxsimp.viz.viewer import Viewer, serve, viewing

__all__ = [
    "COLORS",
    "GOAL_COLOR",
    "OBSTACLE_COLOR",
    "Scene",
    "Viewer",
    "animate",
    "at_time",
    "draw_body",
    "draw_obstacle",
    "make_scene",
    "mean_interval",
    "past_paths",
    "plot_costs",
    "plot_executions",
    "plot_model_errors",
    "plot_models",
    "plot_scores",
    "plot_simplifications",
    "save_frames",
    "save_mesh",
    "scene_of_goal",
    "scene_of_plan",
    "serve",
    "viewing",
    "write_video",
]
