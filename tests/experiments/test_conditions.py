from __future__ import annotations

from collections import Counter

import pytest

from tests.options import options, scenario
from triform.evaluation.scenario import Scenario
from triform.experiments.conditions import CONDITIONS, SWEEPS, ConditionsConfig
from triform.experiments.grid import Grid, flat
from triform.types import ConfigurationError


def test_every_condition_is_swept_over_every_size():
    cells = options(ConditionsConfig, controller="expert").list_cells(set(CONDITIONS))
    counted = Counter(cell.labels["condition"] for cell in cells)
    assert tuple(SWEEPS) == CONDITIONS
    assert counted == {
        "range-noise": 12, "dropped-rays": 10, "scan-rate": 10, "latency": 12, "speed": 10, "acceleration": 8,
        "lag": 10, "footprint": 14, "arena": 8, "team-size": 10, "distance": 10, "event": 9, "guard": 6,
    }  # fmt: skip
    assert len({cell.key for cell in cells}) == len(cells)
    assert len({cell.name for cell in cells}) == len(cells)


def test_one_condition_differs_at_a_time():
    given = {"profile": "hardware", "latency": 0.2}
    base = flat(scenario(**given))
    for cell in options(ConditionsConfig, controller="expert", **given).list_cells(set(CONDITIONS)):
        condition = cell.labels["condition"]
        option = {"team-size": "duration"}.get(condition, SWEEPS[condition].option)
        described = flat(cell.scenario)
        assert {name for name in base if base[name] != described[name]} <= {option}, cell.name


def test_values_are_in_the_units_of_the_scenario():
    cells = {
        (cell.labels["condition"], cell.labels["label"]): cell
        for cell in options(ConditionsConfig, duration=40.0).list_cells(set(CONDITIONS))
    }
    assert cells["range-noise", "0.5"].scenario.overrides.range_noise == 0.005
    assert cells["dropped-rays", "30"].scenario.overrides.dropout == 0.3
    assert cells["scan-rate", "50"].scenario.robot.control_period == 0.02
    assert cells["team-size", "13"].scenario.duration == 40.0
    assert cells["team-size", "25"].scenario.duration == 120.0
    assert cells["event", "meet"].robots == 9


def test_a_guard_that_does_not_go_with_the_robots_is_left_out():
    config = options(ConditionsConfig, controller="expert", which=("guard",), robots=(4,), profile="turtlebot4")
    grid = Grid(config.list_cells({"guard"}))
    assert [cell.labels["label"] for cell in grid.cells] == ["filter", "none"]
    assert list(grid.skipped) == ["guard orca, 4 robots"]
    assert "differential base" in grid.skipped["guard orca, 4 robots"]


def test_orca_in_one_arena_is_not_that_of_another():
    config = options(ConditionsConfig, controller="expert", which=("arena",), robots=(4,), runs=1, guard="orca")
    grid = Grid([cell for cell in config.list_cells({"arena"}) if cell.labels["label"] in ("open", "room-6")])
    assert len({id(grid.controller(cell)) for cell in grid.cells}) == 2


def test_the_ideal_profile_is_one_value_of_its_conditions():
    config = options(ConditionsConfig, controller="expert")
    profile = Scenario().robot
    for condition in ("range-noise", "dropped-rays", "scan-rate", "latency", "speed", "lag", "footprint", "distance"):
        assert sum(cell.scenario.robot == profile for cell in config.list_cells({condition})) == 2, condition


def test_commands_say_what_matters():
    config = options(ConditionsConfig, controller="expert", runs=20, scan_rate=20.0, engine="ray", threads=2)
    assert config.command() == "triform conditions --controller expert --runs 20 --seed 7 --scan-rate 20.0"
    assert config.command("latency").endswith("--which latency --runs 20 --seed 7 --scan-rate 20.0")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"which": ()}, "which is empty"),
        ({"which": ("weather",)}, "no condition 'weather'; there are range-noise"),
        ({"robots": ()}, "robots is empty"),
        ({"robots": (7, 1)}, "robots is 1"),
        ({"runs": 0}, "runs is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"failures": -1}, "failures is -1"),
        ({"event_time": 36.0}, "the event comes at 36 s"),
        ({"event_time": 4.0}, "the event comes at 4 s"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        options(ConditionsConfig, **changes)


def test_the_moment_of_events_matters_only_to_them():
    assert options(ConditionsConfig, which=("latency",), duration=10.0).event_time == 21.0
