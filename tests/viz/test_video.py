"""Videos: what the painter draws, and the files."""

import builtins

import numpy as np
import pytest
from PIL import Image

from jaxsimp import viz
from jaxsimp.dynamics import Sphere, Table
from jaxsimp.viz.raster import BACK, FRONT, Painter
from jaxsimp.viz.scene import at_time, past_paths
from tests.viz.scenes import folded_cloth, lifted


@pytest.fixture(scope="module")
def scene():
    return folded_cloth()


def is_like(picture, color):
    """Pixels whose colour has the direction of another one."""
    away = (
        picture / np.linalg.norm(picture, axis=2, keepdims=True) @ (color / np.linalg.norm(color))
    )
    return away > 0.995


def test_between_frames_positions_are_on_straight_lines(scene):
    motion = scene.trajectory
    for time, frame, part in ((-1.0, 0, 0.0), (0.25, 2, 0.5), (0.3, 3, 0.0), (9.0, 15, 0.0)):
        positions, held = at_time(motion, time)
        after = motion.positions[min(frame + 1, 15)]
        wanted = (1 - part) * motion.positions[frame] + part * after
        np.testing.assert_allclose(positions, wanted, atol=1e-12)
        assert held.tolist() == [0 if frame < 10 else -1]


def test_paths_end_where_the_picker_is(scene):
    assert past_paths(scene.trajectory, 0.0) == []
    ((picker, path),) = past_paths(scene.trajectory, 0.25)
    assert picker == 0
    np.testing.assert_allclose(path[-1, 2] - path[0, 2], 0.2 * 0.25, atol=1e-12)
    ((_, whole),) = past_paths(scene.trajectory, 1.4)
    assert len(whole) == 11


def test_corners_are_drawn_where_the_camera_sees_them(scene):
    painter = Painter(scene, 240, 180)
    positions = scene.trajectory.positions[10]
    picture = painter.paint(positions)
    blue = is_like(picture, FRONT)
    assert not is_like(picture, BACK).any()
    rows, columns = np.nonzero(blue)
    places = painter.place(positions)
    for axis, found in ((0, columns), (1, rows)):
        # Pixels are counted by their corner; an outline covers one on each side.
        assert abs(found.min() - places[:, axis].min()) < 3
        assert abs(found.max() + 1 - places[:, axis].max()) < 3
    assert places.min() >= 0
    assert (places < [240, 180]).all()


def test_the_upper_layer_of_a_fold_hides_the_lower_one(scene):
    """The upper layer is the back; of the lower one, the front, at most an edge is seen."""
    picture = Painter(scene, 240, 180).paint(scene.goal)
    back, front = is_like(picture, BACK).sum(), is_like(picture, FRONT).sum()
    assert back > 20 * front


def test_a_sheet_that_faces_down_shows_its_back(scene):
    painter, flat = Painter(scene, 240, 180), scene.trajectory.positions[10]
    turned = flat * [1, -1, 1]  # a mirror image faces down
    assert is_like(painter.paint(turned), BACK).mean() > 0.05
    assert not is_like(painter.paint(turned), FRONT).any()


def test_an_obstacle_hides_what_is_behind_it(scene):
    ball = Sphere((0.07, -0.15, 0.15), 0.08)  # towards the camera
    with_ball = lifted(scene.body, scene.goal, obstacles=(Table(), ball))
    plain = lifted(scene.body, scene.goal, obstacles=(Table(),))
    positions = scene.trajectory.positions[0]
    alone, hidden = (Painter(each, 240, 180).paint(positions) for each in (plain, with_ball))
    assert is_like(hidden, FRONT).sum() < is_like(alone, FRONT).sum()
    assert np.abs(hidden - alone).max() > 0.2


def test_a_gif_moves_and_its_end_stays(tmp_path, scene):
    path = tmp_path / "fold.gif"
    viz.write_video(path, [scene, scene], frames_per_second=5.0, speed=1.0, panel_width=120)
    with Image.open(path) as found:
        assert found.size == (240, 90)
        lengths = []
        for index in range(found.n_frames):
            found.seek(index)
            lengths.append(found.info["duration"])
        assert sum(lengths) == pytest.approx(1000 * (1.5 + 1.0), abs=250)
    assert [each.name for each in tmp_path.iterdir()] == ["fold.gif"]


def test_an_mp4_has_its_frames(tmp_path, scene):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "fold.mp4"
    viz.write_video(path, scene, frames_per_second=4.0, speed=1.0, panel_width=121)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (count, seconds) == (6 + 4, pytest.approx(2.5, abs=0.1))


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_videos_are_refused(tmp_path, scene, monkeypatch):
    for name, options, told in (
        ("x.avi", {}, r"x.avi is no video; give a file in \.gif, \.mp4"),
        ("x.gif", {"speed": 0}, "speed is 0; give a number from 0.01"),
        ("x.gif", {"frames_per_second": 100}, "frames_per_second is 100; give"),
        ("x.gif", {"panel_width": 5}, "panel_width is 5; give a whole number"),
        ("x.gif", {"scenes": []}, "0 scenes are given"),
    ):
        with pytest.raises(ValueError, match=told):
            viz.write_video(tmp_path / name, **({"scenes": scene} | options))
    plain = builtins.__import__

    def without(name, *rest):
        if name.startswith("imageio_ffmpeg"):
            raise ImportError(name)
        return plain(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'jaxsimp\[video\]'"):
        viz.write_video(tmp_path / "x.mp4", scene)
    assert list(tmp_path.iterdir()) == []
