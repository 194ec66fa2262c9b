from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triform.robots.odometry import EXTRAPOLATION, Track
from triform.robots.robomaster.protocol import (
    chassis_state,
    read_pushed,
    speed_command,
    speeds_of_twist,
    twist_of_speeds,
    twist_of_wheels,
)
from triform.robots.robomaster.watchdog import STOP, Answers


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ([0.1, 0.0, 0.0], "chassis speed x 0.100 y 0.000 z 0.00;"),
        ([-0.25, 0.0, 0.0], "chassis speed x -0.250 y 0.000 z 0.00;"),
        # To the left: the robot's y axis points to the right.
        ([0.0, 0.2, 0.0], "chassis speed x 0.000 y -0.200 z 0.00;"),
        # Counter-clockwise by half a right angle a second: the robot's z turns clockwise, in degrees.
        ([0.0, 0.0, math.pi / 4], "chassis speed x 0.000 y 0.000 z -45.00;"),
        ([1e-7, -1e-7, 0.001], "chassis speed x 0.000 y 0.000 z -0.06;"),
        ([0.0, 0.0, 0.0], "chassis wheel w1 0 w2 0 w3 0 w4 0;"),
        ([1e-4, -1e-4, 1e-5], "chassis wheel w1 0 w2 0 w3 0 w4 0;"),
    ],
)
def test_commands_have_the_signs_and_units_of_the_robot(command, text):
    assert speed_command(np.array(command)) == text


TWISTS = st.tuples(st.floats(-3.5, 3.5), st.floats(-3.5, 3.5), st.floats(-10.4, 10.4))


@given(TWISTS)
def test_a_command_comes_back_to_its_decimals(twist):
    text = speed_command(np.array(twist))
    back = np.zeros(3)
    if text != STOP:
        words = text.rstrip(";").split(" ")
        assert [*words[:2], *words[2::2]] == ["chassis", "speed", "x", "y", "z"]
        back = twist_of_speeds(*map(float, words[3::2]))
    assert np.abs(back - twist)[:2].max() <= 0.0005 + 1e-9
    assert abs(back[2] - twist[2]) <= math.radians(0.005) + 1e-9
    assert "-0.000 " not in text
    assert "-0.00;" not in text


@given(TWISTS)
def test_wheels_turn_as_the_data_sheet_says(twist):
    u_x, u_y, omega = twist
    front_left, front_right = u_x - u_y - 0.2 * omega, u_x + u_y + 0.2 * omega
    rear_left, rear_right = u_x + u_y - 0.2 * omega, u_x - u_y + 0.2 * omega
    rates = np.array([front_right, front_left, rear_right, rear_left]) / (2 * math.pi * 0.05) * 60
    np.testing.assert_allclose(twist_of_wheels(rates), twist, atol=1e-9)


def test_pushes_of_a_real_robot_are_read():
    text = (
        "chassis push attitude -0.894 -0.117 90.000 ; status 0 1 0 0 0 0 0 0 0 0 0 ;"
        "gimbal push attitude -0.300 -0.100 ;"
        "chassis push position 1.500 0.250 ; attitude -0.892 -0.115 -45.000 ;;"
    )
    found = [(name, values.tolist()) for name, values in read_pushed(text)]
    assert found == [
        ("attitude", [pytest.approx(-math.pi / 2)]),
        ("position", [1.5, -0.25]),
        ("attitude", [pytest.approx(math.pi / 4)]),
    ]


def test_a_pose_is_told_with_the_signs_of_the_robot():
    told = chassis_state(np.array([1.0, 2.0, math.pi / 2]), still=True)
    assert told["position"] == ["1.000", "-2.000"]
    assert told["attitude"] == ["0.000", "0.000", "-90.000"]
    assert told["status"] == ["1", *["0"] * 10]


@given(TWISTS)
def test_speeds_of_a_robot_and_its_wheels_come_back(twist):
    speeds, rates = speeds_of_twist(np.array(twist))
    np.testing.assert_allclose(twist_of_speeds(*speeds), twist, atol=1e-9)
    # Rates are whole revolutions per minute.
    np.testing.assert_allclose(twist_of_wheels(np.array(rates)), twist, atol=0.03)


@given(st.text(alphabet="chasi puotn;0.1-enfdr ", max_size=80))
def test_damaged_pushes_are_passed_over(text):
    for name, values in read_pushed(text + ";chassis push position 1 2 ;"):
        assert name in ("position", "attitude")
        assert np.isfinite(values).all()


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"ok;", ["ok"]),
        (b"ok", ["ok"]),
        (b"ok;ok;80 ;", ["ok", "ok", "80"]),
        (b"okok", ["ok", "ok"]),
        (b"ok 80 ", ["ok", "80"]),
        (b"Already in SDK mode", ["Already in SDK mode"]),
        (b"command format error: command parse error;ok;", ["command format error: command parse error", "ok"]),
        (b"broken;", ["broken"]),
        (b" ;\n", []),
    ],
)
def test_answers_are_told_apart_with_and_without_their_ends(data, found):
    answers = Answers()
    assert answers.feed(data) + answers.pause() == found


ANSWERS = st.lists(st.sampled_from(["ok", "fail", "80", "error: ok not", "Already in SDK mode"]), min_size=1)


@given(ANSWERS, st.data())
def test_answers_are_framed_by_the_protocol_and_not_by_the_network(sent, data):
    stream = "".join(f"{answer};" for answer in sent).encode()
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=20)))
    answers = Answers(ended=True)
    pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert [answer for piece in pieces for answer in answers.feed(piece)] == sent
    assert not answers.open
    assert answers.pause() == []


def test_the_first_answer_may_come_byte_by_byte():
    answers = Answers()
    found = []
    for byte in b"ok;ok;Already in SDK mode;ok;":
        found += answers.feed(bytes([byte]))
    assert found == ["ok", "ok", "Already in SDK mode", "ok"]
    assert answers.ended


def test_an_endless_answer_is_cut_off():
    answers = Answers(ended=True)
    assert sum(len(each) for _ in range(100) for each in answers.feed(b"x" * 1000)) >= 90_000
    assert len(answers._rest) <= 1024


@given(
    st.lists(st.floats(0.02, 0.3), min_size=3, max_size=20),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    st.floats(-0.05, 1),
)
def test_a_steady_motion_is_known_between_and_ahead_of_its_samples(steps, speed, place):
    times = 10 + np.cumsum([0.0, *steps])
    track = Track([1.0, 1.0])
    for moment in times:
        track.add(moment, moment * np.array(speed))
    moment = times[0] + place * (times[-1] - times[0])
    for asked in (moment, times[-1] + 0.9 * EXTRAPOLATION):
        found = track.at(asked)
        if asked < times[0]:
            assert found is None
        elif asked <= times[-1] or times[-1] - times[0] >= 0.1:
            np.testing.assert_allclose(found, asked * np.array(speed), atol=1e-9)
    assert track.at(times[-1] + 1.1 * EXTRAPOLATION) is None


def test_samples_that_come_in_bunches_make_no_leaps():
    track = Track([np.inf])
    for arrival, moment in ((0.0, 0.0), (0.05, 0.05), (0.1, 0.1), (0.2499, 0.15), (0.25, 0.2), (0.2501, 0.25)):
        track.add(arrival, np.array([0.1 * moment]))
    assert track.at(0.3)[0] == pytest.approx(0.03, abs=0.005)


def test_nothing_is_known_before_the_first_sample():
    track = Track([np.inf])
    assert track.at(0.0) is None
    track.add(1.0, np.array([2.0]))
    assert track.at(0.9) is None
    assert track.at(1.1) == [2.0]


@given(st.lists(st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 1000.0, 30.0]), min_size=1, max_size=5))
def test_leaps_and_what_is_no_number_are_never_believed(wrong):
    track = Track([0.5])
    now, believed = 0.0, []
    for value in [0.0, 0.1, *wrong, 0.2, 0.3, 0.3]:
        now += 0.05
        track.add(now, np.array([value]))
        found = track.at(now)
        believed.append(found)
        # What is known is near the true numbers, or near those after two that agree: the robot was carried.
        if found is not None and len(set(wrong)) == len(wrong):
            assert 0 <= found[0] <= 0.31
    assert believed[-1] is not None


def test_a_new_zero_is_known_after_two_numbers_that_agree():
    track = Track([0.5, 0.5, 1.0], angle=True)
    for moment, place in ((0.0, 0.0), (0.1, 0.01)):
        track.add(moment, np.array([place, 0.0, 0.0]))
    track.add(0.2, np.array([40.0, 0.0, 3.0]))
    assert track.at(0.2) is None
    track.add(0.3, np.array([40.01, 0.0, 3.0]))
    np.testing.assert_allclose(track.at(0.3), [40.01, 0.0, 3.0])
    assert track.at(0.15) is None
