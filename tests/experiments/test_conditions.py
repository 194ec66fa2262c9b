from __future__ import annotations

from collections import Counter

import pytest

from triform.evaluation.scenario import Scenario
from triform.experiments.conditions import CONDITIONS, SWEEPS, ConditionsConfig, list_cells
from triform.types import ConfigurationError


def test_every_condition_is_swept_over_every_size():
    cells = list_cells(ConditionsConfig(controller="expert"))
    counted = Counter(cell.condition for cell in cells)
    assert tuple(SWEEPS) == CONDITIONS
    assert counted == {
        "range-noise": 12, "dropped-rays": 10, "scan-rate": 10, "latency": 12, "speed": 10, "acceleration": 8,
        "lag": 10, "footprint": 14, "arena": 6, "team-size": 10, "distance": 10, "incident": 7,
    }  # fmt: skip
    assert len({(cell.condition, cell.label, cell.robots) for cell in cells}) == len(cells)
    assert len({cell.name for cell in cells}) == len(cells)


def test_one_condition_differs_at_a_time():
    base = Scenario(controller="expert", profile="hardware", latency=0.2)
    for cell in list_cells(ConditionsConfig(controller="expert", profile="hardware", latency=0.2)):
        option = {"team-size": "duration"}.get(cell.condition, SWEEPS[cell.condition].option)
        differing = {name for name in vars(base) if getattr(base, name) != getattr(cell.scenario, name)}
        assert differing <= {option}, cell.name
        _ = cell.scenario.robot


def test_values_are_in_the_units_of_the_scenario():
    cells = {(cell.condition, cell.label): cell for cell in list_cells(ConditionsConfig(duration=40.0))}
    assert cells["range-noise", "0.5"].scenario.range_noise == 0.005
    assert cells["dropped-rays", "30"].scenario.dropout == 0.3
    assert cells["scan-rate", "50"].scenario.robot.control_period == 0.02
    assert cells["team-size", "13"].scenario.duration == 40.0
    assert cells["team-size", "25"].scenario.duration == 120.0
    assert cells["incident", "meet"].robots == 9


def test_the_ideal_profile_is_one_value_of_its_conditions():
    config = ConditionsConfig(controller="expert")
    profile = Scenario().robot
    for condition in ("range-noise", "dropped-rays", "scan-rate", "latency", "speed", "lag", "footprint", "distance"):
        own = [cell for cell in list_cells(config) if cell.condition == condition]
        assert sum(cell.scenario.robot == profile for cell in own) == 2, condition


def test_commands_say_what_matters():
    config = ConditionsConfig(controller="expert", runs=20, scan_rate=20.0, engine="ray", threads=2)
    assert config.command() == "triform conditions --controller expert --scan-rate 20.0 --runs 20 --seed 7"
    assert config.command("latency").endswith("--scan-rate 20.0 --which latency --runs 20 --seed 7")


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
        ({"incident_time": 36.0}, "incident_time is 36.0 s"),
        ({"incident_time": 4.0}, "incident_time is 4.0 s"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        ConditionsConfig(**changes)


def test_the_moment_of_incidents_matters_only_to_them():
    assert ConditionsConfig(which=("latency",), duration=10.0).incident_time == 21.0
