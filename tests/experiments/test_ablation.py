from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.options import options
from triform.cli import main
from triform.commands.terminal import Terminal
from triform.control import Triangulating, TriangulatingLaw
from triform.control.triangulating import BLOCKING_RADIUS
from triform.evaluation import Scenario
from triform.experiments import ablation
from triform.experiments.ablation import (
    VARIANTS,
    AblateConfig,
    NoisyPositions,
    Variant,
    run_ablate,
)
from triform.experiments.evaluate import EvaluateConfig, evaluate
from triform.simulation import World, get_profile, world_seeds
from triform.types import ConfigurationError, TriformError

QUICK = {"robots": (3, 4), "runs": 2, "seed": 3, "duration": 6.0, "threads": 1}
FEW = {name: VARIANTS[name] for name in ("whole law", "no compaction", "sees through robots", "noisy positions")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished ablation of a few terms, not to be written to."""
    from io import StringIO

    from rich.console import Console

    output = tmp_path_factory.mktemp("ablation")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "VARIANTS", FEW)
        run_ablate(options(AblateConfig, output=output, **QUICK), Terminal(Console(file=StringIO(), width=80)))
    return output


def team(worlds=3, robots=5):
    rng = np.random.default_rng(2)
    poses = np.concatenate([rng.uniform(0, 3, (worlds, robots, 2)), rng.uniform(-3, 3, (worlds, robots, 1))], axis=-1)
    return World(poses, get_profile("ideal"), seeds=list(range(worlds)))


def test_all_files_are_written(folder):
    assert {path.name for path in folder.iterdir()} == {
        "ablation.json", "ablation.parquet", "ablation.png", "ablation.pdf", "ablation.md", "ablation.html",
    }  # fmt: skip
    page = (folder / "ablation.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"]
    assert rows[0] == [
        "law", "changed", "strict 3", "strict 4", "p strict", "success 3", "success 4", "p success", "strict at 3",
        "strict at 4", "p strict at",
    ]  # fmt: skip
    assert [row[0] for row in rows[2:]] == list(FEW)
    assert rows[2][4] == "ref"
    assert f"p: {len(FEW) - 1} comparisons with whole law" in page
    assert "`triform ablate --robots 3 4 --runs 2 --seed 3" in page
    written = json.loads((folder / "ablation.json").read_text())
    assert [(cell["label"], cell["robots"]) for cell in written["cells"]] == [(v, n) for v in FEW for n in (3, 4)]
    assert written["variants"]["no compaction"]["law"]["compaction_speed"] == 0
    assert "controller" not in written["config"]
    assert [(row["label"], row["reference"], row["strict"]["pairs"]) for row in written["paired"]] == [
        (label, "whole law", 4) for label in list(FEW)[1:]
    ]


def test_the_whole_law_is_the_controller_called_triangulating(folder):
    config = options(EvaluateConfig, controller="triangulating", robots=(3, 4), runs=2, seed=3, duration=6.0, threads=1)
    frame = pd.read_parquet(folder / "ablation.parquet")
    own = frame[frame.label == "whole law"]
    for name, column in evaluate(config).runs.items():
        np.testing.assert_array_equal(own[name], column, err_msg=name)
    settings = json.loads((folder / "ablation.json").read_text())["cells"][0]["settings"]
    alone = Scenario().make_controller("triangulating").description
    assert settings["controller_description"] == alone


def test_every_term_is_left_out_by_itself():
    tuned = TriangulatingLaw()
    names = set()
    for label, variant in VARIANTS.items():
        changed = {name for name, value in vars(variant.law).items() if value != getattr(tuned, name)}
        assert changed == set(variant.constants), label
        others = (variant.blocking_radius != BLOCKING_RADIUS) + (variant.position_noise > 0)
        assert len(changed) + others == {"whole law": 0, "no pushes": 2}.get(label, 1), label
        assert all(name in variant.change for name in changed), label
        names |= changed
    assert names == {
        "contact_gain", "yield_strain", "far_gain", "odd_gain", "compaction_speed", "bridge_pull", "bridge_push",
        "hinge_pull", "firm_degree", "strain_push", "sight",
    }  # fmt: skip


def test_without_yielding_an_edge_is_a_plain_spring():
    law = VARIANTS["no yield"].law
    still = {"odd_gain": 0.0, "compaction_speed": 0.0, "far_gain": 0.0}
    controller = Triangulating(law=TriangulatingLaw(**(vars(law) | still)), max_speed=10.0)
    # A triangle, so that no edge is a bridge.
    corners = np.array([[0.0, 0.0, 0.0], [1.25, 0.0, 0.0], [0.5, 0.8, 0.0]])
    world = World(corners[None], get_profile("ideal"))
    lengths = np.linalg.norm(corners[1:, :2], axis=1)
    expected = sum(law.gain * (r - 1) / r * x for r, x in zip(lengths, corners[1:, :2], strict=True))
    unpushed = replace(world.observe(), noise=None)
    np.testing.assert_allclose(controller.command(unpushed)[0, 0, :2], expected, rtol=1e-12)


class Recorder:
    """Remembers the poses that it is shown."""

    privileged = True
    description = {"name": "recorder"}  # noqa: RUF012

    def __init__(self):
        self.shown = []

    def command(self, view):
        self.shown.append(view.poses)
        return np.zeros(view.poses.shape)


def test_noise_is_as_large_as_asked_and_new_at_every_moment():
    recorder = Recorder()
    noisy = NoisyPositions(recorder, 0.02)
    world = team(20, 30)
    for _ in range(6):
        noisy.command(world.observe())
        world.apply(np.zeros(world.poses.shape), 0.1)
    shown = np.stack(recorder.shown)
    np.testing.assert_array_equal(shown[..., 2], np.broadcast_to(world.poses[..., 2], shown.shape[:-1]))
    errors = (shown - world.poses)[..., :2]
    seen = errors[:, :, 1:] - errors[:, :, :1]
    assert abs(seen.std() / 0.02 - 1) < 0.1
    flat = errors.reshape(6, -1)
    assert np.abs(np.corrcoef(flat) - np.eye(6)).max() < 0.1
    # Nor has it to do with the pushes themselves.
    assert abs(np.corrcoef(flat[0], team(20, 30).observe().noise.ravel())[0, 1]) < 0.1
    assert noisy.description == {"name": "recorder", "position_noise": 0.02}


def test_noise_does_not_depend_on_other_worlds():
    together, alone = Recorder(), Recorder()
    NoisyPositions(together, 0.02).command(team(3).observe())
    poses = team(3).poses[1:2]
    NoisyPositions(alone, 0.02).command(World(poses, get_profile("ideal"), seeds=[1]).observe())
    np.testing.assert_array_equal(together.shown[0][1:2], alone.shown[0])


def test_noise_reaches_every_robot_of_a_mixed_team():
    scenario = Scenario("hardware:1 turtlebot4:2")
    view = scenario.make_world(scenario.sample_starts(3, 1, 7), world_seeds(3, 7, [0])).observe()
    recorder = Recorder()
    NoisyPositions(recorder, 0.02).command(view)
    assert (recorder.shown[0] != view.poses)[..., :2].all()
    moved = view.with_poses(recorder.shown[0])
    np.testing.assert_array_equal(np.concatenate([part.poses for part in moved.parts], axis=1), recorder.shown[0])
    assert moved.due == view.due


def test_noise_needs_pushes():
    view = replace(team().observe(), noise=None)
    with pytest.raises(TriformError, match="carry exploration noise"):
        NoisyPositions(Recorder(), 0.02).command(view)


def test_variants_can_be_sent_to_another_machine():
    controller = Scenario().make_controller(VARIANTS["noisy positions"].controller(1.0))
    far = pickle.loads(pickle.dumps(controller))
    assert far.description == controller.description
    assert far.description["position_noise"] == 0.02
    assert "guard" in far.description
    bare = Scenario(guard="none").make_controller(Variant().controller(1.0))
    assert bare.description == Triangulating().description


def test_larger_teams_get_more_time():
    cells = options(AblateConfig, robots=(13, 14, 13), runs=5).cells
    assert len(cells) == 2 * len(VARIANTS)
    assert {(cell.robots, cell.scenario.duration, cell.runs) for cell in cells} == {(13, 40.0, 5), (14, 120.0, 5)}
    assert Variant().law == TriangulatingLaw()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": ()}, "robots is empty"),
        ({"robots": (5, 2)}, "robots is 2"),
        ({"runs": 0}, "runs is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"duration": 4.0}, "duration is 4"),
    ],
)
def test_bad_settings_of_an_ablation_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        options(AblateConfig, **changes)


def test_the_command_hides_what_it_chooses_itself(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(ablation, "VARIANTS", {"whole law": VARIANTS["whole law"]})
    options = ["--robots", "3", "--runs", "1", "--duration", "5", "--threads", "1", "--output", str(tmp_path)]
    assert main(["ablate", *options]) == 0
    assert "whole law" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["ablate", "--controller", "expert"])
    assert "--controller" in capsys.readouterr().err
