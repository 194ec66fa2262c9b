from __future__ import annotations

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest

from tests.options import scenario
from triform.control import weights_folder
from triform.evaluation import Trajectory, rollout
from triform.figures.maps import figure_7_maps, robot_maps
from triform.figures.paper import snapshot_records
from triform.figures.runs import Scene
from triform.figures.style import robot_colours
from triform.policy import read_spec

SPEC = read_spec(weights_folder("near"))


@pytest.fixture
def standing():
    """Robot 0 looks along y; robot 1 is 1 m before it, and robot 2 half a metre to its left."""
    chosen = scenario(duration=6.0)
    world = chosen.make_world(np.array([[[0.0, 0.0, np.pi / 2], [0.0, 1.0, 0.0], [-0.5, 0.0, 0.0]]]), [0])

    class Still:
        privileged = False

        def command(self, view):
            return np.zeros((1, 3, 3))

    return chosen, rollout(world, Still(), 6.0, scans=True)


def test_a_map_is_drawn_with_the_front_up_and_the_left_side_on_the_left(standing):
    chosen, run = standing
    scene = Scene(chosen.robot.footprint, chosen.surroundings)
    figure = figure_7_maps([run], [scene], SPEC, ["run 0"])
    moments = len(snapshot_records(run.time))
    wholes = figure.axes[1::2]
    assert len(wholes) == moments
    panels = [axes for axes in wholes[-1].child_axes if axes.images]
    assert len(panels) == 3
    (image,) = panels[0].images
    occupied, (left, right, bottom, top) = ~np.ma.getmaskarray(image.get_array()), image.get_extent()
    rows, columns = np.nonzero(occupied)
    size = len(occupied)
    # Across the picture from its left edge, and up from its lower one, in the units of its axes.
    across = left + (columns + 0.5) / size * (right - left)
    up = top - (rows + 0.5) / size * (top - bottom)
    assert panels[0].get_xlim() == (left, right)
    assert left > right
    ahead, beside = np.hypot(across, up - 1.0) < 0.3, np.hypot(across - 0.5, up) < 0.3
    assert ahead.any()
    assert beside.any()
    assert (ahead | beside).all()
    for axes, colour in zip(panels, robot_colours(3), strict=True):
        assert axes.spines["left"].get_edgecolor() == colour
    plt.close(figure)


def test_runs_without_scans_and_scans_without_maps_are_shown_too(standing):
    chosen, run = standing
    scene = Scene(chosen.robot.footprint, chosen.surroundings)
    plain = dataclasses.replace(run, senses=())
    figure = figure_7_maps([plain, run], [scene] * 2, SPEC, ["a", "b"])
    moments = len(snapshot_records(run.time))
    assert len(figure.axes) == 3 * moments
    plt.close(figure)
    short = dataclasses.replace(run.senses[0].scan, range_max=1.0)
    near = dataclasses.replace(run, senses=(dataclasses.replace(run.senses[0], scan=short),))
    assert robot_maps(near, 0, 1.0, SPEC) == {}
    figure = figure_7_maps([near], [scene], SPEC, ["a"])
    assert [text.get_text() for text in figure.axes[1].child_axes[0].texts] == ["no map"]
    plt.close(figure)


def test_absent_robots_have_no_map(standing):
    _, run = standing
    active = np.array(run.senses[0].active)
    active[:, :, 1] = False
    gone = dataclasses.replace(run, senses=(dataclasses.replace(run.senses[0], active=active),))
    assert isinstance(gone, Trajectory)
    assert sorted(robot_maps(gone, 0, 1.0, SPEC)) == [0, 2]
