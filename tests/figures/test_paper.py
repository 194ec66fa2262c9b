from __future__ import annotations

import dataclasses
import json

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from PIL import Image

from tests.formations import hexagon, still
from tests.options import options
from triform.evaluation import measure, paper
from triform.evaluation.metrics import concatenate
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.experiments.reproduce import ReproduceConfig, run_reproduce
from triform.figures.paper import figure_2, figure_9, snapshot_records
from triform.figures.style import save_figure


def assert_picture(paths):
    path, _ = paths
    with Image.open(path) as image:
        assert np.asarray(image.convert("L")).std() > 5


@pytest.mark.parametrize(
    ("duration", "period", "shown"),
    [(40.0, 0.1, [0, 2, 5, 10, 20, 40]), (20.0, 0.125, [0, 2, 5, 10, 20]), (6.0, 0.1, [0, 2, 5, 6])],
)
def test_snapshots_are_at_round_moments_and_at_the_end(duration, period, shown):
    time = period * np.arange(round(duration / period) + 1)
    np.testing.assert_allclose(time[snapshot_records(time)], shown)


def test_figure_2_shows_ways_and_graph_at_every_moment(tmp_path, scene):
    trajectory = still([hexagon()], duration=12.0)
    drift = 0.05 * trajectory.time[None, :, None]
    poses = np.array(trajectory.poses)
    poses[..., 0] += drift
    moving = dataclasses.replace(trajectory, poses=poses)
    figure = figure_2([moving, still([hexagon()[:4]], duration=12.0)], scene)
    panels = np.array(figure.axes).reshape(2, 5)
    for axes, record in zip(panels[0], snapshot_records(moving.time), strict=True):
        ways = [line for line in axes.get_lines() if len(line.get_xdata()) == record + 1]
        assert len(ways) == 7
        for way in ways:
            assert way.get_xdata()[-1] - way.get_xdata()[0] == pytest.approx(0.05 * moving.time[record])
        graph = next(each for each in axes.collections if isinstance(each, LineCollection))
        assert len(graph.get_segments()) == 12
        assert sum(isinstance(each, PolyCollection) for each in axes.collections) >= 1
    widths = {round(float(np.diff(axes.get_xlim())[0]), 9) for axes in panels.flat}
    assert len(widths) == 1
    assert_picture(save_figure(figure, tmp_path / "fig2.png"))


@pytest.mark.parametrize("spacing", [1.0, 1.5])
def test_figure_9_always_shows_what_was_published(spacing, tmp_path):
    runs = measure(still([spacing * hexagon()[:4]] * 3))
    figure = figure_9(runs, "runs")
    errors, times = figure.axes
    assert errors.get_ylim()[1] > 100 * paper.REAL_MEDIAN_ERROR
    assert times.get_ylim()[1] > paper.REAL_CONVERGE_TIME
    count = int(np.isfinite(runs["converge_time"]).sum())
    assert times.get_xticklabels()[0].get_text() == f"4\nn={count}"
    assert_picture(save_figure(figure, tmp_path / "fig9.png"))


def test_figure_9_has_a_box_for_every_team_size():
    runs = concatenate([measure(still([hexagon()[:robots]] * 2)) for robots in (4, 7)])
    figure = figure_9(runs, "runs")
    assert [len(axes.get_xticks()) for axes in figure.axes] == [2, 2]
    plt.close(figure)


def test_figure_9_shows_an_evaluation_of_the_hardware_profile(tmp_path, listener):
    scenario = {"controller": "expert", "duration": 6.0, "runs": 3, "seed": 5}
    run_reproduce(options(ReproduceConfig, what="fig9", output=tmp_path, **scenario), listener)
    found = json.loads((tmp_path / "fig9.json").read_text())
    expected = evaluate(options(EvaluateConfig, robots=(4,), profile="hardware", **scenario))
    assert found["results"][0]["formation_error_median"] == expected.results[0]["formation_error_median"]
    assert found["paper"] == {"robots": 4, "formation_error_median": 0.09, "converge_time_median": 14.0}
    page = (tmp_path / "index.md").read_text()
    assert "| 4 (paper) |" in page
    assert "no real robot drove here" in page
