from __future__ import annotations

import dataclasses
import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from shapely.geometry import LineString, Point, Polygon

from tests.formations import hexagon, still
from triform.control import POLICY, ControllerSpec
from triform.evaluation import measure
from triform.evaluation.events import Event
from triform.evaluation.metrics import concatenate
from triform.evaluation.overrides import Overrides
from triform.evaluation.scenario import Scenario
from triform.figures.animation import animate
from triform.figures.runs import Scene, TeamChange, figure_3, figure_4, figure_5, run_figure
from triform.figures.sensing import sense_again
from triform.figures.sheet import contact_sheet, failure
from triform.figures.sight import sight_figure
from triform.figures.style import (
    BLUE,
    GREEN,
    GREY,
    HELD,
    INK,
    VERMILLION,
    bounds,
    edge_colours,
    edge_lines,
    footprint_outlines,
    heading_marks,
    map_colours,
    rgb,
    robot_colours,
    save_figure,
)
from triform.simulation import ROBOMASTER_EP, Arena, Composition, Footprint, get_arena, get_profile
from triform.types import TriformError

IDEAL = Composition.of(get_profile("ideal"))
EXPERT = ControllerSpec("expert")


def film(trajectory, scene, path, **options):
    return animate(trajectory, scene, IDEAL, path, controller=EXPERT, **options)


def assert_picture(paths):
    path, vectors = paths
    assert vectors == path.with_suffix(".pdf")
    assert vectors.read_bytes().startswith(b"%PDF")
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
    path, vectors = save_figure(run_figure(still([hexagon()]), scene, ""), tmp_path / "run.png")
    old = path.read_bytes()
    figure = run_figure(still([hexagon()]), scene, "other")

    def interrupted(file, **options):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(figure, "savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_figure(figure, path)
    assert path.read_bytes() == old
    assert sorted(tmp_path.iterdir()) == [vectors, path]
    assert not plt.get_fignums()


def test_equal_figures_give_equal_bytes(tmp_path, scene):
    first, second = (
        [path.read_bytes() for path in save_figure(run_figure(still([hexagon()]), scene, ""), tmp_path / f"{name}.png")]
        for name in "ab"
    )
    assert first == second


def test_legends_hide_no_curve(tmp_path, scene):
    later = dataclasses.replace(scene, event=Event("push", 3.0))
    figure = run_figure(still([1.3 * hexagon()]), later, "title")
    figure.draw_without_rendering()
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    assert len(legends) == 2
    for legend in legends:
        for axes in figure.axes:
            assert not legend.get_window_extent().overlaps(axes.get_window_extent())
    plt.close(figure)


def test_edges_have_the_colours_of_their_lengths():
    lengths = np.array([0.5, 1.0, 1.03, 1.2, 1.6, 2.5])
    short, right, near, between, far, unseen = edge_colours(lengths, 1.0).tolist()
    assert (short, right, far, unseen) == tuple(rgb(each).tolist() for each in (BLUE, GREEN, VERMILLION, GREY))
    assert near == right
    low, high = np.minimum(right, far), np.maximum(right, far)
    assert (low < between).all()
    assert (between < high).all()
    np.testing.assert_array_equal(edge_colours(0.5 * lengths, 0.5), edge_colours(lengths, 1.0))


def test_a_map_is_drawn_with_forward_up_and_left_left():
    occupancy = np.zeros((6, 6), dtype=np.uint8)
    occupancy[5, 4] = 1
    image = map_colours(occupancy, 3)
    dark, held = rgb(INK), rgb(HELD)
    assert (image[0, 1] == dark).all()
    # Its patch is the one ahead and to the left; the others are empty.
    assert (image[:3, :3].reshape(-1, 3) == held).all(axis=1).sum() == 8
    assert (image[3:] == 255).all()
    assert (image[:, 3:] == 255).all()
    assert (map_colours(occupancy, 0) == 255).all(axis=-1).sum() == 35


@pytest.mark.parametrize("profile", ["ideal", "hardware"])
def test_a_robot_sees_again_what_it_saw(profile):
    scenario = Scenario(profile=profile, arena="room-6", duration=5.0)
    trajectory, _ = scenario.run(scenario.sample_starts(4, 1, 3), "expert", 3)
    records = [0, len(trajectory.time) - 1]
    arena = scenario.surroundings
    for record, sensing in zip(
        records, sense_again(trajectory, records, 2, scenario.team, arena, POLICY, 1.0), strict=True
    ):
        pose = trajectory.poses[0, record, 2]
        np.testing.assert_allclose(sensing.pose, pose)
        # Every return lies on an outline of another robot or on a wall, within the noise of the LiDAR.
        bodies = [Polygon(outline) for outline in footprint_outlines(trajectory.poses[0, record], 4 * [ROBOMASTER_EP])]
        things = [body.exterior for robot, body in enumerate(bodies) if robot != 2]
        things += [LineString(wall) for wall in arena.walls.reshape(-1, 2, 2)]
        tolerance = 1e-5 if profile == "ideal" else 0.15
        gaps = [min(Point(hit).distance(thing) for thing in things) for hit in sensing.hits]
        assert len(gaps) > 50
        assert max(gaps) < tolerance
        lengths = np.linalg.norm(sensing.hits_body, axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(sensing.hits - pose[:2], axis=1))
        assert not sensing.dim.any()


def test_returns_of_furniture_are_dim(tmp_path):
    scenario = Scenario(arena="pillars", overrides=Overrides(min_intensity=230.0), duration=5.0)
    trajectory, _ = scenario.run(scenario.sample_starts(5, 1, 3), "expert", 3)
    scene = Scene(ROBOMASTER_EP, scenario.surroundings)
    (sensing,) = sense_again(trajectory, [0], 0, scenario.team, scene.arena, POLICY, 1.0)
    bodies = [Polygon(each) for each in footprint_outlines(trajectory.poses[0, 0], 5 * [ROBOMASTER_EP])]
    on_robot = np.array([min(Point(hit).distance(body) for body in bodies[1:]) < 1e-4 for hit in sensing.hits])
    np.testing.assert_array_equal(sensing.dim, ~on_robot)
    assert 0 < on_robot.sum() < len(on_robot)
    assert_picture(save_figure(sight_figure(trajectory, scene, scenario.team, POLICY), tmp_path / "sight.png"))


def test_a_sheet_frames_what_failed(tmp_path, scene):
    teams = [hexagon(), 1.5 * hexagon(), hexagon()[[0, 1, 4]], hexagon()[:2]]
    trajectories = [still([team]) for team in teams]
    runs = concatenate([measure(each) for each in trajectories])
    runs["collision"] = np.array([False, False, False, True])
    assert [failure(runs, run) for run in range(4)] == ["", "no success", "not strict", "overlap"]
    assert failure(measure(still([hexagon()[:2]])), 0) == ""
    figure = contact_sheet(trajectories, [scene] * 4, runs)
    (axes,) = figure.axes
    framed = next(each for each in axes.collections if mpl.colors.same_color(each.get_edgecolor()[0], VERMILLION))
    assert len(framed.get_paths()) == 3
    assert "4 runs of 2 to 7 robots: 1 strict, 3 successful, 1 with an overlap" in figure.get_suptitle()
    written = [text.get_text() for text in axes.texts]
    assert written == ["0  ", "1  no success", "2  not strict", "3  overlap"]
    assert_picture(save_figure(figure, tmp_path / "sheet.png"))


@pytest.mark.parametrize("robots", [1, 7])
def test_animation_has_the_promised_speed(robots, tmp_path, scene):
    (path,) = film(still([hexagon()[:robots]], duration=8.0), scene, tmp_path / "run.gif", speed=4.0)
    with Image.open(path) as image:
        durations = []
        for index in range(image.n_frames):
            image.seek(index)
            durations.append(image.info["duration"])
    # Frames without change are merged; together they last 8 s / 4, and the last one stays longer.
    assert sum(durations) == pytest.approx(2000 + 2000, abs=100)


def test_a_video_plays_everywhere_and_as_long_as_the_gif(tmp_path, scene):
    av = pytest.importorskip("av")
    gif, video = film(still([hexagon()]), scene, tmp_path / "run.gif", video=tmp_path / "run.mp4", speed=20.0)
    with av.open(video) as container:
        (stream,) = container.streams
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.duration * stream.time_base) == pytest.approx(2.4, abs=0.1)
        last = list(container.decode(stream))[-1].to_ndarray(format="rgb24").astype(float)
    with Image.open(gif) as image:
        image.seek(image.n_frames - 1)
        drawn = np.asarray(image.convert("RGB")).astype(float)
    assert np.abs(last - drawn).mean() < 3


def test_without_pyav_no_video_is_begun(tmp_path, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ModuleNotFoundError):
        film(still([hexagon()]), scene, tmp_path / "run.gif", video=tmp_path / "run.mp4")
    assert not any(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named_and_nothing_stays_open(tmp_path, scene):
    trajectory = still([hexagon()])
    for write in (
        lambda path: save_figure(run_figure(trajectory, scene, ""), path),
        lambda path: film(trajectory, scene, path, speed=40.0),
    ):
        with pytest.raises(TriformError, match="cannot write"):
            write(tmp_path / "missing" / "x.png")
    assert not plt.get_fignums()
