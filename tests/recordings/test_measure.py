from __future__ import annotations

import json

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from shapely import affinity

from tests.formations import hexagon, still
from tests.options import options
from triform.evaluation import Trajectory, summarise
from triform.evaluation.metrics import measure
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.figures.recorded import figure_7, figure_8
from triform.recordings.description import RunSetting
from triform.recordings.measure import MeasureConfig, contacts_of_records, run_measure
from triform.simulation import FOOTPRINTS, Arena
from triform.types import ConfigurationError, TriformError


@pytest.fixture
def teams(tmp_path):
    """Recorded at 10 Hz: two runs of seven robots at the right distance, and one of two robots too far apart."""
    together = still([hexagon(), hexagon(1.05)])
    np.save(tmp_path / "seven.npy", together.poses)
    apart = still([[[0.0, 0.0], [3.0, 0.0]]])
    np.save(tmp_path / "two.npy", apart.poses[0])
    return tmp_path / "seven.npy", tmp_path / "two.npy"


def test_files_hold_the_form_of_an_evaluation_and_every_run(tmp_path, listener, teams):
    config = MeasureConfig(teams, rate=10, json=tmp_path / "deep" / "out.json", figures=tmp_path / "figures")
    found = run_measure(config, listener)
    written = json.loads((tmp_path / "deep" / "out.json").read_text())
    driven = evaluate(options(EvaluateConfig, controller="expert", robots=(2,), runs=1, duration=6.0))
    assert set(written) == set(driven.as_json())
    assert set(written["results"][0]) == set(driven.as_json()["results"][0])
    # The robots of one team are out of each other's sight, so it is reported apart.
    assert [result["robots"] for result in written["results"]] == [2, 7]
    assert [result["runs"] for result in written["results"]] == [0, 2]
    assert [result["robots"] for result in written["disconnected_starts"]] == [2]
    expected = {"robots": 7, **summarise(measure(still([hexagon(), hexagon(1.05)])))}
    assert set(found.results[1]) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found.results[1][name], value, atol=1e-9, err_msg=name)
    assert written["config"]["controller"] == "recorded"
    assert written["config"]["recordings"][0]["duration"] == 8.0
    frame = pd.read_parquet(tmp_path / "deep" / "out.parquet").set_index("run").sort_index()
    assert frame.recording.tolist() == [f"{teams[0]}, run 0", f"{teams[0]}, run 1", str(teams[1])]
    assert frame.robots.tolist() == [7, 7, 2]
    for name in ("fig7.png", "fig8.png", "fig9.png", "sheet.png"):
        with Image.open(tmp_path / "figures" / name) as image:
            assert np.asarray(image.convert("L")).std() > 5
    assert "fig9.png" in listener.console.file.getvalue()


def test_comings_and_goings_are_told(tmp_path, listener):
    poses = still([hexagon()]).poses[0]
    poses[40:, 6] = np.nan
    np.save(tmp_path / "run.npy", poses)
    evaluation = run_measure(MeasureConfig((tmp_path / "run.npy",), rate=10), listener)
    assert "robot 6 goes at 3.90 s" in listener.console.file.getvalue().replace("\n", " ")
    assert evaluation.runs["robots"].tolist() == [6]


@pytest.mark.parametrize(
    ("chosen", "says"),
    [
        ({"files": ()}, "no file is named"),
        ({"files": ("a.csv",), "footprint": "moon"}, "footprint is 'moon'"),
        ({"files": ("a.npy",)}, "rate is missing"),
        ({"files": ("a.csv",), "rate": 10.0}, "rate is 10.0 Hz; it is only for recordings in .npy"),
        ({"files": ("a.npy",), "rate": 0.0}, "rate is 0.0 Hz; it must be positive"),
        ({"files": ("a.csv",), "start": -1.0}, "start is -1.0 s"),
        ({"files": ("a.csv",), "start": 5.0, "end": 5.0}, "end is 5.0 s; it must be later than start"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, chosen, says):
    files = tuple(map(tmp_path.joinpath, chosen["files"]))
    with pytest.raises(ConfigurationError, match=says):
        MeasureConfig(**(chosen | {"files": files}))


def test_places_that_cannot_be_written_are_found_before_anything_is_read(tmp_path, listener):
    (tmp_path / "file").write_text("")
    config = MeasureConfig((tmp_path / "none.csv",), figures=tmp_path / "file")
    with pytest.raises(TriformError, match="cannot write to the output folder"):
        run_measure(config, listener)


def outline(pose, footprint):
    shape = shapely.Polygon(footprint.corners)
    if footprint.is_circle:
        shape = shapely.Point(0, 0).buffer(footprint.half_length, quad_segs=256)
    turned = affinity.rotate(shape, pose[2], origin=(0, 0), use_radians=True)
    return affinity.translate(turned, *pose[:2])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["ep", "engineer", "circle-15", "box-30"]))
def test_overlaps_are_those_of_shapely_at_the_records(seed, name):
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-0.6, -0.6, -np.pi], [0.6, 0.6, np.pi], (2, 4, 3))
    active = rng.random((2, 4)) < 0.8
    poses[~active] = np.nan
    run = Trajectory(np.arange(2.0), poses[None], active[None], np.zeros((1, 1, 4, 3)))
    shapes = [[outline(pose, FOOTPRINTS[name]) for pose in record if np.isfinite(pose[0])] for record in poses]
    areas = [a.intersection(b).area for record in shapes for i, a in enumerate(record) for b in record[:i]]
    expected = max(areas, default=0.0)
    # Shapely's circles have corners, so they decide nothing about the last tenth of a millimetre.
    if not 0 < expected < 1e-6:
        setting = RunSetting(1.0, FOOTPRINTS[name], Arena.open())
        assert contacts_of_records(run, setting) == (expected > 0, False)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_every_run_has_its_panels(scene, count):
    runs = [still([hexagon()]) for _ in range(count)]
    for figure, parts in ((figure_7(runs, [scene] * count), 1), (figure_8(runs, [scene] * count), 2)):
        assert len(figure.axes) == parts * count
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        assert [title for title in titles if title] == [f"run {index}, 7 robots" for index in range(count)]
        plt.close(figure)
