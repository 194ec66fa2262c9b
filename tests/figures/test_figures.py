from __future__ import annotations

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from tests.formations import hexagon, still
from triform.evaluation import measure
from triform.evaluation.metrics import concatenate
from triform.figures.animation import animate
from triform.figures.runs import Scene, TeamChange, figure_3, figure_4, figure_5, run_figure
from triform.figures.style import bounds, edge_lines, footprint_outlines, heading_marks, robot_colours, save_figure
from triform.simulation import ROBOMASTER_EP, Arena, Footprint, get_arena
from triform.types import TriformError


def assert_picture(path):
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert np.asarray(image.convert("L")).std() > 5


def test_outlines_are_turned_with_the_robot():
    (outline,) = footprint_outlines(np.array([[1.0, 2.0, np.pi / 2]]), [ROBOMASTER_EP])
    half = np.abs(outline - [1.0, 2.0])
    np.testing.assert_allclose(half, np.broadcast_to([0.12, 0.16], (4, 2)), atol=1e-12)
    (mark,) = heading_marks(np.array([[1.0, 2.0, np.pi / 2]]), [ROBOMASTER_EP])
    np.testing.assert_allclose(mark, [[1.0, 2.0], [1.0, 2.16]], atol=1e-12)


def test_circles_are_round():
    (outline,) = footprint_outlines(np.zeros((1, 3)), [Footprint.circle(0.3)])
    np.testing.assert_allclose(np.linalg.norm(outline, axis=-1), 0.15)


def test_every_edge_is_drawn_once():
    graph = np.array([[0, 1, 1], [1, 0, 0], [1, 0, 0]], dtype=bool)
    assert len(edge_lines(np.zeros((3, 2)), graph)) == 2


def test_bounds_ignore_absent_robots():
    middle, half = bounds(np.array([[0.0, 0.0], [2.0, 1.0], [np.nan, np.nan]]), Arena.open(), margin=0.5)
    np.testing.assert_allclose(middle, [1.0, 0.5])
    assert half == pytest.approx(1.5)


def test_bounds_hold_the_whole_arena():
    middle, half = bounds(np.zeros((1, 2)), Arena.room(6.0, 4.0, center=(1.0, 0.0)), margin=0.0)
    np.testing.assert_allclose(middle, [1.0, 0.0])
    assert half == pytest.approx(3.0)


def test_colours_differ():
    assert len(set(robot_colours(13))) == 13
    assert len(robot_colours(1)) == 1


@pytest.mark.parametrize("robots", [1, 2, 7])
def test_run_figure_of_any_team(robots, tmp_path, scene):
    figure = run_figure(still([hexagon()[:robots]]), scene, "title")
    assert_picture(save_figure(figure, tmp_path / "run.png"))
    assert not plt.get_fignums()


def test_run_figure_with_absent_robots_walls_and_pillars(tmp_path):
    trajectory = still([hexagon()], active=[[True, False] * 3 + [True]])
    scene = Scene(Footprint.circle(0.3), get_arena("pillars"))
    assert_picture(save_figure(run_figure(trajectory, scene, "title"), tmp_path / "run.png"))


def test_figure_3_has_a_column_per_team_with_equal_scales(scene):
    figure = figure_3([still([hexagon()[:robots]]) for robots in (3, 7)], scene)
    assert len(figure.axes) == 4
    widths = [np.diff(axes.get_xlim()) for axes in figure.axes[2:]]
    np.testing.assert_allclose(widths[0], widths[1])
    plt.close(figure)


def test_figure_4_draws_teams_that_never_converge(tmp_path):
    good, bad = still([hexagon()] * 3), still([1.5 * hexagon()[:5]] * 3)
    runs = concatenate([measure(good), measure(bad)])
    assert_picture(save_figure(figure_4(runs, "expert"), tmp_path / "fig4.png"))


def test_figure_5_draws_who_came_and_who_went(tmp_path, scene):
    smaller, larger = [True] * 6 + [False], [True] * 7
    before, after = (still([hexagon()], duration=6.0, active=[who]) for who in (smaller, larger))
    later = dataclasses.replace(after, time=after.time + 6.0)
    earlier = dataclasses.replace(before, time=before.time + 6.0)
    changes = [
        TeamChange(before.then(later), 6.0, "6 → 7 robots"),
        TeamChange(after.then(earlier), 6.0, "7 → 6 robots"),
    ]
    assert_picture(save_figure(figure_5(changes, scene), tmp_path / "fig5.png"))


def test_an_interrupted_drawing_leaves_the_old_picture(tmp_path, scene, monkeypatch):
    path = save_figure(run_figure(still([hexagon()]), scene, ""), tmp_path / "run.png")
    old = path.read_bytes()
    figure = run_figure(still([hexagon()]), scene, "other")

    def interrupted(file, **options):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(figure, "savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_figure(figure, path)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]
    assert not plt.get_fignums()


@pytest.mark.parametrize("robots", [1, 7])
def test_animation_has_the_promised_speed(robots, tmp_path, scene):
    path = animate(still([hexagon()[:robots]], duration=8.0), scene, tmp_path / "run.gif", speed=4.0)
    with Image.open(path) as image:
        durations = []
        for index in range(image.n_frames):
            image.seek(index)
            durations.append(image.info["duration"])
    # Frames without change are merged; together they last 8 s / 4, and the last one stays longer.
    assert sum(durations) == pytest.approx(2000 + 2000, abs=100)


def test_a_place_that_cannot_be_written_is_named_and_nothing_stays_open(tmp_path, scene):
    trajectory = still([hexagon()])
    for write in (
        lambda path: save_figure(run_figure(trajectory, scene, ""), path),
        lambda path: animate(trajectory, scene, path),
    ):
        with pytest.raises(TriformError, match="cannot write"):
            write(tmp_path / "missing" / "x.png")
    assert not plt.get_fignums()
