from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triform.robots.odometry import EXTRAPOLATION, Track
from triform.robots.robomaster.protocol import pushed, read_pushed, speed_command, twist_of_speeds, twist_of_wheels
from triform.robots.robomaster.watchdog import STOP, answers


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


def test_a_pose_is_pushed_with_the_signs_of_the_robot():
    text = "chassis push position 1.000 -2.000 ; attitude 0.000 0.000 -90.000 ;"
    assert pushed(np.array([1.0, 2.0, math.pi / 2]), ["position", "attitude"]) == text


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
        (b"Already in SDK mode", ["Already in SDK mode"]),
        (b"command format error: command parse error;ok;", ["command format error: command parse error", "ok"]),
        (b"broken;", ["broken"]),
        (b" ;\n", []),
    ],
)
def test_answers_are_told_apart_with_and_without_their_ends(data, found):
    assert answers(data) == found


@given(
    st.lists(st.floats(0.02, 0.3), min_size=3, max_size=20),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    st.floats(-0.05, 1),
)
def test_a_steady_motion_is_known_between_and_ahead_of_its_samples(steps, speed, place):
    times = 10 + np.cumsum([0.0, *steps])
    track = Track()
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
    track = Track()
    for arrival, moment in ((0.0, 0.0), (0.05, 0.05), (0.1, 0.1), (0.2499, 0.15), (0.25, 0.2), (0.2501, 0.25)):
        track.add(arrival, np.array([0.1 * moment]))
    assert track.at(0.3)[0] == pytest.approx(0.03, abs=0.005)


def test_nothing_is_known_before_the_first_sample():
    track = Track()
    assert track.at(0.0) is None
    track.add(1.0, np.array([2.0]))
    assert track.at(0.9) is None
    assert track.at(1.1) == [2.0]
