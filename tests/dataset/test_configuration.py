from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triform.dataset import PRESETS, CollectionConfig
from triform.dataset.configuration import config_from_json
from triform.types import ConfigurationError

PAPER, QUICK = PRESETS["paper"], PRESETS["quick"]


def test_the_paper_preset_is_the_papers_data_set() -> None:
    assert (PAPER.runs, PAPER.steps, PAPER.robots, PAPER.placements) == (600, 1000, 7, 400_000)
    assert PAPER.distance == 1.0
    assert PAPER.records == 1_000_000
    assert PAPER.maps == 7_000_000


@pytest.mark.parametrize("name", PRESETS)
def test_configurations_survive_json(name: str) -> None:
    config = PRESETS[name]
    assert config_from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robots": 0}, "robots is 0"),
        ({"steps": 2.5}, "steps is 2.5"),
        ({"runs": 0, "placements": 0}, "nothing to collect"),
        ({"seed": -1}, "seed is -1"),
        ({"distance": float("nan")}, "distance is nan"),
        ({"speed_limit": float("inf")}, "speed_limit is inf"),
        ({"teacher": "nobody"}, "no expert 'nobody'; there are expert, expert-sensed, expert-odd"),
        ({"jitter": ()}, "jitter is"),
        ({"jitter": (0.0, -1.0)}, "jitter is"),
        ({"validation_share": 1.5}, "validation_share is 1.5"),
    ],
)
def test_bad_values_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        replace(PAPER, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda values: values.pop("seed"),
        lambda values: values.update(extra=1),
        lambda values: values["scan"].pop("rays"),
        lambda values: values.update(steps="many"),
        lambda values: values.update(map=None),
    ],
)
def test_foreign_json_is_refused(spoil: object) -> None:
    values = QUICK.to_json()
    spoil(values)  # type: ignore[operator]
    with pytest.raises(ConfigurationError):
        config_from_json(values)


@settings(deadline=None, max_examples=50)
@given(
    runs=st.integers(0, 30),
    steps=st.integers(1, 40),
    placements=st.integers(1, 300),
    block=st.integers(1, 50),
    shard_runs=st.integers(1, 8),
    group=st.integers(1, 50),
    share=st.floats(0, 1),
)
def test_shards_runs_and_groups_partition_the_records(
    runs: int, steps: int, placements: int, block: int, shard_runs: int, group: int, share: float
) -> None:
    config = CollectionConfig(
        runs=runs,
        steps=steps,
        placements=placements,
        block_placements=block,
        shard_runs=shard_runs,
        group_records=group,
        validation_share=share,
    )
    listed = [run for shard in range(config.shards) for run in config.shard_range(shard)]
    assert listed == list(range(config.all_runs))
    assert sum(config.run_records(run) for run in listed) == config.records == runs * steps + placements
    for run in listed:
        assert [step for steps_ in config.groups(run) for step in steps_] == list(range(config.run_records(run)))
        assert max(len(steps_) for steps_ in config.groups(run)) <= group

    held_out = config.validation_runs()
    assert len(set(held_out)) == len(held_out)
    assert np.sum(held_out < runs) == round(runs * share)
    assert np.sum(held_out >= runs) == round(config.blocks * share)
    np.testing.assert_array_equal(held_out, replace(config).validation_runs())


def test_another_seed_holds_out_other_runs() -> None:
    assert not np.array_equal(PAPER.validation_runs(), replace(PAPER, seed=2).validation_runs())
    assert len({*(PAPER.start_seed(placements=each) for each in (False, True)), PAPER.seed}) == 3
