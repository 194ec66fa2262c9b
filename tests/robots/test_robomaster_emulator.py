"""The emulated RoboMaster speaks what DJI's page ``protocol_api`` documents, and is as strict."""

from __future__ import annotations

import math
import os
import re
import socket
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from triform.robots.robomaster import RoboMasterEmulator

#: An address of this machine that no other test process uses.
ADDRESS = f"127.79.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"


@pytest.fixture
def emulator():
    with RoboMasterEmulator(ADDRESS, control_port=0) as robot:
        yield robot


def until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.005)


class Line:
    """Talks to a robot by hand."""

    def __init__(self, emulator):
        self.socket = socket.create_connection((emulator.address, emulator.control_port), 10)

    def ask(self, text):
        self.socket.sendall(text.encode())
        return self.socket.recv(100).decode()


def test_the_emulator_is_strict(emulator):
    line = Line(emulator)
    with line.socket:
        line.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            line.ask("chassis speed x 0.1 y 0 z 0;")
        line.socket.settimeout(10)
        assert line.ask("command;") == "ok;"
        assert line.ask("command;") == "Already in SDK mode;"
        assert line.ask("robot battery ?;") == "100 ;"
        for wrong in ("chassis", "chassis speed x 1", "chassis jump", " robot battery ?", "robot mode sideways", ""):
            assert line.ask(f"{wrong};") == "command format error: command parse error;"
        for refused in (
            "chassis speed x 3.6 y 0 z 0",
            "chassis speed x 0 y 0 z 601",
            "chassis speed x nan y 0 z 0",
            "chassis wheel w1 1001 w2 0 w3 0 w4 0",
            "chassis wheel w1 a w2 0 w3 0 w4 0",
            "chassis push position on pfreq 7",
            "chassis push position perhaps",
            "chassis push height on",
            "chassis push position",
        ):
            assert line.ask(f"{refused};") == "fail;"
        assert not emulator.command.any()
        assert line.ask("chassis wheel w1 60 w2 60 w3 60 w4 60;") == "ok;"
        np.testing.assert_allclose(emulator.command, [2 * math.pi * 0.05, 0, 0])
        line.socket.sendall(b"chassis spe")
        assert line.ask("ed x 0.1 y 0.2 z 90;") == "ok;"
        np.testing.assert_allclose(emulator.command, [0.1, -0.2, -math.pi / 2])
        assert line.ask("quit;") == "ok;"
        assert not emulator.command.any()


def drain(pushes):
    for _ in range(100):
        pushes.recv(1000)


def test_telemetry_comes_at_its_rate_until_switched_off(emulator):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pushes:
        pushes.bind((ADDRESS, 40924))
        pushes.settimeout(10)
        with socket.create_connection((emulator.address, emulator.control_port), 10, (ADDRESS, 0)) as robot:
            emulator.tell(np.array([1.0, 2.0, math.pi / 2]), np.zeros(3))
            robot.sendall(b"command;chassis push position on pfreq 50 attitude on afreq 5;")
            texts = [pushes.recv(1000).decode() for _ in range(21)]
            assert all(text.startswith("chassis push ") and text.endswith(" ;") for text in texts)
            assert sum("position 1.000 -2.000 ;" in text for text in texts) >= 16
            assert 2 <= sum("attitude 0.000 0.000 -90.000 ;" in text for text in texts) <= 5
            robot.sendall(b"chassis push position off attitude off;")
            pushes.settimeout(0.5)
            until(lambda: not emulator._rates)
            with pytest.raises(TimeoutError):
                drain(pushes)


@pytest.fixture
def line(emulator):
    talk = Line(emulator)
    with talk.socket:
        assert talk.ask("command;") == "ok;"
        yield talk


NUMBER = r"-?\d+(\.\d+)?"


def numbers(count):
    return " ".join([NUMBER] * count)


#: The examples of the page, in its order, and the form of their answers.
EXAMPLES = {
    "robot mode chassis_lead": "ok",
    "robot mode ?": "chassis_lead",
    "chassis speed x 0.1 y 0.1 z 1": "ok",
    "chassis wheel w2 100 w1 12 w3 20 w4 11": "ok",
    "chassis move x 0.1 y 0.2": "ok",
    "chassis speed ?": numbers(7),
    "chassis position ?": numbers(3),
    "chassis attitude ?": numbers(3),
    "chassis status ?": " ".join(["[01]"] * 11),
    "chassis push position on pfreq 1 attitude on": "ok",
    "chassis push freq 10": "ok",
    "chassis push position pfreq 1 freq 5": "ok",
    "chassis push attitude on": "ok",
    "chassis push attitude on status on": "ok",
    "chassis push attitude on afreq 1 status on sfreq 5": "ok",
    "gimbal speed p 1 y 1": "ok",
    "gimbal move p 10": "ok",
    "gimbal moveto p 10 y -20 vp 0.1": "ok",
    "gimbal suspend": "ok",
    "gimbal resume": "ok",
    "gimbal recenter": "ok",
    "gimbal attitude ?": numbers(2),
    "gimbal push attitude on": "ok",
    "blaster bead 2": "ok",
    "blaster fire": "ok",
    "blaster bead ?": "2",
    "armor sensitivity 1": "ok",
    "armor sensitivity ?": "1",
    "armor event hit on": "ok",
    "sound event applause on": "ok",
    "pwm value 1 50": "ok",
    "pwm freq 1 1000": "ok",
    "led control comp all r 255 g 0 b 0 effect solid": "ok",
    "sensor_adapter adc id 1 port 1 ?": NUMBER,
    "sensor_adapter io_level id 1 port 1 ?": "[01]",
    "sensor_adapter pulse_period id 1 port 1": NUMBER,
    "sensor_adapter event io_level on": "ok",
    "ir_distance_sensor measure on": "ok",
    "ir_distance_sensor distance 1 ?": NUMBER,
    "servo angle id 1 angle 20": "ok",
    "servo speed id 1 speed 20": "ok",
    "servo stop": "ok",
    "servo angle id 1 ?": r"20\.000",
    "robotic_arm moveto x 5 y 5": "ok",
    "robotic_arm move x 5 y 5": "ok",
    "robotic_arm position ?": r"10\.000 10\.000",
    "robotic_arm stop": "ok",
    "robotic_arm recenter": "ok",
    "robotic_gripper open 1": "ok",
    "robotic_gripper status ?": "2",
    "robotic_gripper close leve 1": "ok",
    "stream on": "ok",
    "stream off": "ok",
    "audio on": "ok",
    "audio off": "ok",
}


def test_it_speaks_every_example_of_the_page(line):
    for example, form in EXAMPLES.items():
        assert re.fullmatch(f"{form};", line.ask(f"{example};")), example


def test_arguments_may_come_in_any_order(line, emulator):
    # The page's own example: 12, 100, 20 and 11 revolutions per minute of w1 to w4.
    assert line.ask("chassis wheel w2 100 w1 12 w3 20 w4 11;") == "ok;"
    np.testing.assert_allclose(emulator.command, [0.187, -0.127, -0.517], atol=5e-4)
    assert line.ask("chassis speed z 90 y 0.2 x 0.1;") == "ok;"
    np.testing.assert_allclose(emulator.command, [0.1, -0.2, -math.pi / 2])
    for wrong in ("chassis speed x 0.1 x 0.1 z 1", "chassis speed x 0.1 y 0.1 z 1 w 2", "chassis move vxy 1"):
        assert line.ask(f"{wrong};") == "command format error: command parse error;"


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.permutations(["x", "y", "z"]), st.tuples(st.floats(-3.5, 3.5), st.floats(-3.5, 3.5), st.floats(-600, 600)))
def test_every_order_of_speeds_is_the_same_twist(line, emulator, order, speeds):
    given = dict(zip("xyz", speeds, strict=True))
    assert line.ask(f"chassis speed {' '.join(f'{name} {given[name]:.4f}' for name in order)};") == "ok;"
    x, y, z = speeds
    np.testing.assert_allclose(emulator.command, [x, -y, -math.radians(z)], atol=1e-4)


def test_it_tells_where_it_is_and_how_it_moves(line, emulator):
    emulator.tell(np.array([1.0, 1.5, math.radians(-20)]), np.zeros(3))
    assert line.ask("chassis position ?;") == "1.000 -1.500 20.000;"
    assert line.ask("chassis attitude ?;") == "0.000 0.000 20.000;"
    assert line.ask("chassis status ?;") == "1 0 0 0 0 0 0 0 0 0 0;"
    emulator.tell(np.zeros(3), np.array([2 * math.pi * 0.05, 0.0, 0.0]))
    assert line.ask("chassis speed ?;") == "0.314 0.000 0.000 60 60 60 60;"
    assert line.ask("chassis status ?;").startswith("0 ")


def test_it_moves_to_a_place_and_stands(line, emulator):
    before = time.monotonic()
    assert line.ask("chassis move x 0.1 y 0.1 vxy 1 z 30 vz 300;") == "ok;"
    after = time.monotonic()
    (there, ahead), (done, turning) = emulator._plan
    assert before + math.hypot(0.1, 0.1) <= there <= after + math.hypot(0.1, 0.1)
    np.testing.assert_allclose(ahead * math.hypot(0.1, 0.1), [0.1, -0.1, 0.0])
    np.testing.assert_allclose(turning * (done - there), [0.0, 0.0, math.radians(30)])
    until(lambda: not emulator.command.any())
    assert time.monotonic() >= done


def test_one_rate_holds_for_all_pushes(line, emulator):
    line.ask("chassis push position on pfreq 1 attitude on afreq 1 status on;")
    assert emulator._rates == {"position": 1, "attitude": 1, "status": 5}
    line.ask("chassis push freq 10;")
    assert set(emulator._rates.values()) == {10}
    line.ask("chassis push status off position on pfreq 1 freq 30;")
    assert emulator._rates == {"position": 30, "attitude": 30}
