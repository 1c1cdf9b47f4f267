"""Moving pages: what is in the file, and what a browser shows of it."""

import base64
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsimp import goals, viz
from jaxsimp.bodies import cloth, rope
from jaxsimp.bodies.garments import skirt
from jaxsimp.dynamics import Box, Capsule, Plane, Sphere, Table
from jaxsimp.engines import Trajectory
from jaxsimp.viz.animation import LEVELS, MOST_PANELS, quantised, quantum
from jaxsimp.viz.scene import Scene, scene_of_goal
from jaxsimp.viz.shapes import obstacle_mesh, outline, shown_faces, tube
from tests.viz.chromium import FOUND, browser
from tests.viz.scenes import folded_cloth, lifted

needs_chromium = pytest.mark.skipif(
    FOUND is None, reason="no Chromium is installed: apt-get install chromium"
)


@pytest.fixture(scope="module")
def cloth_scene():
    return folded_cloth()


@pytest.fixture(scope="module")
def rope_scene():
    body = rope(21)
    return lifted(body, goals.letter(body, "U"), "a rope")


def panels_of(path):
    """What the page was given, as a browser reads it."""
    (text,) = re.findall(r"^const PANELS = (.*);$", path.read_text(), re.MULTILINE)
    return json.loads(text)


def decoded(panel, name):
    whole = np.frombuffer(base64.b64decode(panel[name]), "<u2").reshape(-1, 3)
    return np.array(panel["low"]) + panel["step"] * whole


# --- the file ------------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.floats(1e-3, 12.0), st.floats(-5.0, 5.0))
def test_quantised_positions_are_right_within_a_tenth_of_a_millimetre(seed, extent, middle):
    positions = middle + extent * (np.random.default_rng(seed).random((3, 7, 3)) - 0.5)
    limits = np.stack([positions.min(axis=(0, 1)), positions.max(axis=(0, 1))])
    step = quantum(limits)
    whole = quantised(positions, limits[0], step)
    # Half a step of rounding, and what float64 adds.
    assert np.abs(limits[0] + step * whole - positions).max() <= 0.5 * step + 1e-12
    assert step <= extent / LEVELS * (1 + 1e-9)
    assert 0.5 * step < 1e-4


def test_positions_are_read_back_from_the_page(tmp_path, cloth_scene, rope_scene):
    viz.animate(tmp_path / "page.html", [cloth_scene, rope_scene])
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    for scene, panel in zip(
        (cloth_scene, rope_scene), panels_of(tmp_path / "page.html"), strict=True
    ):
        wanted = scene.trajectory.positions.reshape(-1, 3)
        assert np.abs(decoded(panel, "positions") - wanted).max() < 1e-4
        assert np.abs(decoded(panel, "goal") - scene.goal).max() < 1e-4
        assert panel["times"] == scene.trajectory.times.tolist()
        assert panel["held"] == scene.trajectory.held.tolist()


def test_ten_seconds_of_a_paper_cloth_are_less_than_3_mb(tmp_path):
    body = cloth((25, 25))
    noise = np.random.default_rng(0).random((301, body.num_particles, 3))
    still = Trajectory(np.arange(301) / 30, body.rest + 0.01 * noise, np.zeros((300, 2), int))
    viz.animate(tmp_path / "page.html", Scene("long", body, goals.flat(body), still))
    assert (tmp_path / "page.html").stat().st_size < 3e6


def test_the_page_needs_nothing_else(tmp_path, cloth_scene):
    viz.animate(tmp_path / "page.html", cloth_scene)
    text = (tmp_path / "page.html").read_text()
    assert not re.findall(r"https?:|import |src=|@import|url\(", text)


def test_a_title_cannot_end_the_script(tmp_path):
    body = rope(5)
    title = "</script><script>alert(1)</script> \u2028 $& é"
    viz.animate(tmp_path / "page.html", scene_of_goal(body, goals.flat(body), title=title))
    assert (tmp_path / "page.html").read_text().count("</script>") == 1
    assert panels_of(tmp_path / "page.html")[0]["title"] == title


def test_a_motion_is_shown_up_to_where_it_is_not_finite(cloth_scene):
    positions = cloth_scene.trajectory.positions.copy()
    positions[5:, 3] = np.nan
    motion = Trajectory(cloth_scene.trajectory.times, positions, cloth_scene.trajectory.held)
    shown = Scene("unstable", cloth_scene.body, cloth_scene.goal, motion).trajectory
    assert (len(shown.times), len(shown.positions), len(shown.held)) == (5, 5, 4)
    broken = Trajectory(motion.times, np.full_like(positions, np.nan), motion.held)
    with pytest.raises(ValueError, match="the first frame is not finite; give"):
        Scene("unstable", cloth_scene.body, cloth_scene.goal, broken)


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_scenes_are_refused(tmp_path, cloth_scene, monkeypatch):
    for scenes, told in (
        ([], "0 scenes are given; give 1 to 12"),
        ([cloth_scene] * (MOST_PANELS + 1), "13 scenes are given"),
        ("plan.npz", "scenes is 'plan.npz'; give a Scene or a list"),
        ([cloth_scene, None], "give a Scene or a list"),
    ):
        with pytest.raises(ValueError, match=told):
            viz.animate(tmp_path / "page.html", scenes)
    body, goal, motion = cloth_scene.body, cloth_scene.goal, cloth_scene.trajectory
    for changed, told in (
        ({"title": 3}, "title is 3; give a text"),
        ({"key_points": [81]}, "key_points names 81; the ids of 81 particles"),
        ({"costs": ["cheap"]}, "costs is .*; give real numbers"),
        ({"goal": goal[:5]}, "the goal has shape"),
        ({"obstacles": (Sphere((0.0, 0.0, 0.0), 1e-3),)}, "slip"),
        ({"body": cloth((5, 5)), "goal": goals.flat(cloth((5, 5)))}, "positions has shape"),
    ):
        given = {"title": "x", "body": body, "goal": goal, "trajectory": motion} | changed
        with pytest.raises(ValueError, match=told):
            Scene(**given)
    monkeypatch.setattr("jaxsimp.viz.animation.MOST_COORDINATES", 100)
    with pytest.raises(ValueError, match="coordinates in all their frames, and a page holds 100"):
        viz.animate(tmp_path / "page.html", cloth_scene)
    monkeypatch.undo()
    with pytest.raises(OSError, match="No such file"):
        viz.animate(tmp_path / "none" / "page.html", cloth_scene)
    assert list(tmp_path.iterdir()) == []


# --- shapes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "obstacle",
    [
        Sphere((0.1, 0.0, 0.2), 0.1),
        Capsule((-0.2, 0.0, 0.3), (0.2, 0.1, 0.3), 0.04),
        Box((0.0, 0.3, 0.1), (0.2, 0.1, 0.1), 0.02, 0.5),
        Plane((0.0, 0.0, 0.1), (0.0, 1.0, 0.0)),
        Plane((0.0, 0.0, 0.1), (0.3, -0.2, 1.0)),
    ],
)
def test_an_obstacle_is_drawn_where_its_distance_is_zero(obstacle):
    limits = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]])
    mesh = obstacle_mesh(obstacle, limits)
    points, normals, faces = mesh.points, mesh.normals, mesh.faces
    np.testing.assert_allclose(
        obstacle.distance(*points.T)[0], 0.0, atol=5e-6
    )  # float32, from 10 m away
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    across = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(across, axis=1)
    assert area.max() > 0
    # A triangle looks out as its corners do.
    large = area > 1e-3 * area.max()
    assert (np.einsum("ij,ij->i", across, normals[faces[:, 0]])[large] != 0).all()
    if isinstance(obstacle, Sphere):
        assert area.sum() == pytest.approx(4 * np.pi * 0.1**2, rel=5e-3)  # chords of 3.75 degrees


def test_the_front_of_a_sheet_is_its_top_and_a_rope_has_none():
    for body in (cloth((4, 5)), rope(5)):
        faces = shown_faces(body)
        a, b, c = np.moveaxis(body.rest[faces], 1, 0)
        assert (np.cross(b - a, c - a)[:, 2] > 0).all()
        assert np.array_equal(np.sort(faces), np.sort(body.faces))
    assert len(outline(cloth((4, 5)))) == 2 * (3 + 4)
    assert len(outline(rope(5))) == 0


# --- in a browser --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


def is_drawn(picture):
    """Which pixels are neither background nor table: bodies have colours."""
    return picture.max(axis=2) - picture.min(axis=2) > 60


@needs_chromium
def test_a_browser_shows_the_cloth_and_the_time_moves_it(tmp_path, page, cloth_scene):
    viz.animate(tmp_path / "page.html", cloth_scene)
    page.open(tmp_path / "page.html", "#t=0")
    first = page.picture()
    assert (page.run("time"), page.run("playing")) == (0, False)
    drawn = is_drawn(first)
    assert drawn.mean() > 0.03
    assert not drawn[:, :20].any()  # all of it is seen
    assert not drawn[:, -10:].any()
    assert np.array_equal(page.picture(), first)  # and stands still
    left, top, width, height = page.place("#time")
    page.drag(left + 10, top + height / 2, left + 0.6 * width, top + height / 2)
    assert page.run("time") == pytest.approx(0.9, abs=0.05)
    later = page.picture()
    assert (np.abs(later - first).max(axis=2) > 40).mean() > 0.01
    assert page.run("PANELS[0].now[2]") == pytest.approx(
        0.2 * 0.9 + cloth_scene.body.radius, abs=0.02
    )
    assert page.faults == []


@needs_chromium
def test_the_mouse_turns_and_zooms(tmp_path, page, rope_scene):
    viz.animate(tmp_path / "page.html", rope_scene)
    page.open(tmp_path / "page.html", "#t=0.5")
    first = page.picture()
    page.drag(200, 200, 300, 200)
    turned = page.picture()
    assert (np.abs(turned - first).max(axis=2) > 40).mean() > 0.002
    page.drag(200, 200, 200, 240)
    assert (np.abs(page.picture() - turned).max(axis=2) > 40).mean() > 0.002
    turned = page.picture()
    page.mouse("mouseWheel", 200, 200, deltaX=0, deltaY=-400)
    zoomed = page.picture()
    assert is_drawn(zoomed).sum() > 1.5 * is_drawn(turned).sum()
    page.run("canvas.dispatchEvent(new MouseEvent('dblclick'))")
    assert np.array_equal(page.picture(), first)
    assert page.faults == []


@needs_chromium
def test_it_plays_and_goal_and_pickers_can_be_hidden(tmp_path, page, cloth_scene, rope_scene):
    box = Box((0.0, 0.5, 0.1), (0.2, 0.1, 0.1))
    around = (Table(), box, Capsule((-0.3, 0.4, 0.3), (0.3, 0.4, 0.3), 0.06))
    garment = skirt().body
    scenes = [
        lifted(cloth_scene.body, cloth_scene.goal, "x" * 300, obstacles=around),
        rope_scene,
        scene_of_goal(garment, goals.flat(garment), [0, 5]),
    ]
    viz.animate(tmp_path / "page.html", scenes)
    page.open(tmp_path / "page.html")
    page.run("play(true)")
    started = page.run("new Promise((done) => setTimeout(() => done(time), 400))")
    assert 0 < started < 1.5
    page.run("play(false); seek(0.7)")
    first = page.picture()
    halves = np.array_split(is_drawn(first), 2, axis=0)
    assert all(half.any() for half in halves)
    changed = {}
    for name in ("goal", "points", "paths"):
        page.run(f"document.getElementById('{name}').click()")
        changed[name] = (np.abs(page.picture() - first).max(axis=2) > 20).sum()
        page.run(f"document.getElementById('{name}').click()")
    assert min(changed.values()) > 30, changed
    assert page.faults == []


@needs_chromium
def test_a_goal_alone_has_no_slider(tmp_path, page):
    body = rope(9)
    viz.animate(tmp_path / "page.html", scene_of_goal(body, goals.letter(body, "U"), title="U"))
    page.open(tmp_path / "page.html")
    assert is_drawn(page.picture()).mean() > 0.003
    assert page.run("getComputedStyle(document.getElementById('player')).display") == "none"
    assert page.run("document.title") == "U"
    assert page.faults == []


def test_a_tube_is_round_about_its_line_and_closed():
    """Its volume is that of a cylinder and of a ball for both ends."""
    line = np.stack([np.linspace(0, 1, 11), np.zeros(11), np.full(11, 0.5)], axis=1)
    mesh = tube(line, 0.05)
    a, b, c = np.moveaxis(mesh.points[mesh.faces], 1, 0)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    # Twelve sides: sin(30 degrees) / 30 degrees of the circle; ends of four rings have less.
    assert abs(volume) == pytest.approx(np.pi * 0.05**2 * (1 + 4 / 3 * 0.05), rel=0.06)
    nearest = mesh.points * [1, 0, 0] + [0, 0, 0.5]
    nearest[:, 0] = nearest[:, 0].clip(0, 1)
    np.testing.assert_allclose(np.linalg.norm(mesh.points - nearest, axis=1), 0.05, rtol=1e-6)
