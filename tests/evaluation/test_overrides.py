from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.options import options, scenario
from triform.control import IntensityThreshold, SafetyFilter
from triform.evaluation import Scenario
from triform.evaluation.overrides import Overrides
from triform.experiments.evaluate import EvaluateConfig, run_evaluate
from triform.simulation import FOOTPRINTS, HARDWARE, IDEAL, PROFILES, constant_noise
from triform.types import ConfigurationError


@pytest.mark.parametrize("profile", PROFILES)
def test_without_conditions_a_robot_is_its_profile(profile):
    assert Scenario(profile=profile).robot == PROFILES[profile].seeing(3.0)


@settings(deadline=None)
@given(
    st.sampled_from(sorted(PROFILES)),
    st.fixed_dictionaries(
        {},
        optional={
            "range_noise": st.floats(0.0, 0.1),
            "dropout": st.floats(0.0, 1.0),
            "latency": st.floats(0.0, 1.0),
            "speed_limit": st.floats(0.01, 2.0),
            "acceleration": st.floats(0.1, 5.0),
            "lag": st.floats(0.0, 0.5),
            "footprint": st.sampled_from(sorted(FOOTPRINTS)),
        },
    ),
    st.floats(0.3, 4.0),
)
def test_each_condition_replaces_its_own_value_and_no_other(profile, changes, distance):
    own = PROFILES[profile]
    robot = scenario(profile=profile, distance=distance, **changes).robot
    assert robot.lidar.scan.range_max == min(3 * distance, 8)
    assert robot.lidar.dropout == changes.get("dropout", own.lidar.dropout)
    assert robot.latency == changes.get("latency", own.latency)
    limits = {"max_speed": "speed_limit", "max_acceleration": "acceleration", "lag": "lag"}
    changed = {name: changes[option] for name, option in limits.items() if option in changes}
    assert robot.drive == replace(own.drive, **changed)
    assert robot.footprint == (FOOTPRINTS[changes["footprint"]] if "footprint" in changes else own.footprint)
    if "range_noise" not in changes:
        assert robot.lidar.noise == own.lidar.noise
    elif changes["range_noise"] > 0:
        assert robot.lidar.noise == constant_noise(changes["range_noise"])
    else:
        assert robot.lidar.noise == ()
    scan = replace(robot.lidar.scan, range_max=own.lidar.scan.range_max)
    same = replace(robot.lidar, scan=scan, noise=own.lidar.noise, dropout=own.lidar.dropout)
    assert replace(robot, lidar=same, drive=own.drive, footprint=own.footprint, latency=own.latency) == own


def test_commands_keep_step_with_the_scans_where_they_did():
    ideal, hardware = (scenario(profile=name, scan_rate=20.0).robot for name in ("ideal", "hardware"))
    own, other = IDEAL.seeing(3.0), HARDWARE.seeing(3.0)
    assert ideal == replace(own, lidar=replace(own.lidar, period=0.05), control_period=0.05)
    assert hardware == replace(other, lidar=replace(other.lidar, period=0.05))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"range_noise": -0.01}, "range_noise is -0.01 m"),
        ({"dropout": 1.1}, "dropout is 1.1"),
        ({"scan_rate": 0.0}, "scan_rate is 0.0 Hz"),
        ({"latency": float("inf")}, "latency is inf s"),
        ({"speed_limit": 0.0}, "speed_limit is 0.0 m/s"),
        ({"acceleration": 0.0}, r"acceleration is 0.0 m/s\^2"),
        ({"lag": -0.1}, "lag is -0.1 s"),
        ({"sight": 1.9}, r"sight is 1.9 d\*; it must be finite and at least 2 d\*"),
        ({"sight": float("inf")}, r"sight is inf d\*"),
        ({"distance": 4.5}, "at most 4 m, because a robot needs 2 d"),
    ],
)
def test_bad_conditions_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        scenario(**changes)


def test_an_unknown_footprint_is_refused():
    with pytest.raises(ConfigurationError, match="footprint is 'moon'; allowed are ep, engineer"):
        scenario(footprint="moon")


def test_robots_fit_side_by_side_at_the_start():
    for name in FOOTPRINTS:
        assert 2 * FOOTPRINTS[name].circumradius < 0.5


def test_results_record_the_robot_as_it_was_run(tmp_path, listener):
    config = options(
        EvaluateConfig, controller="scan-pipeline", robots=(3,), runs=2, duration=6.0, range_noise=0.01, scan_rate=20.0,
        footprint="circle-15", distance=0.8, json=tmp_path / "out.json",
    )  # fmt: skip
    run_evaluate(config, listener)
    written = json.loads((tmp_path / "out.json").read_text())["config"]
    recorded = written["profile_description"]
    assert (recorded["footprint"]["length"], recorded["control_period"]) == (0.3, 0.05)
    assert recorded["lidar"]["noise"] == [{"up_to": None, "absolute": 0.01, "relative": 0.0}]
    assert recorded["lidar"]["scan"]["range_max"] == pytest.approx(2.4)
    assert {name: written[name] for name in asdict(Overrides())} == {
        "range_noise": 0.01, "dropout": None, "scan_rate": 20.0, "latency": None, "speed_limit": None,
        "acceleration": None, "lag": None, "footprint": "circle-15", "odometry": True,
        "min_intensity": None,
    }  # fmt: skip


@pytest.mark.parametrize("guard", ["filter", "none"])
def test_a_threshold_of_intensity_stands_between_filter_and_controller(guard):
    """Pillars as thick as robots: with tape the team forms up as if they were not there, and touches nothing."""
    place = Scenario(arena="pillars", guard=guard, duration=20.0)
    taped = replace(place, overrides=Overrides(min_intensity=230.0))
    assert taped.robot.lidar.min_intensity == 230
    controller = taped.make_controller("scan-triangulating")
    assert controller.description["min_intensity"] == 230
    assert isinstance(controller, SafetyFilter if guard == "filter" else IntensityThreshold)
    assert taped.make_controller(controller).description == controller.description
    starts = place.sample_starts(5, 4, 3)
    _, rows = taped.run(starts, controller, seed=3)
    assert rows["strict"].all()
    assert not rows["hit_arena"].any()
    _, plain = place.run(starts, "scan-triangulating", seed=3)
    assert plain["strict"].sum() < 4
