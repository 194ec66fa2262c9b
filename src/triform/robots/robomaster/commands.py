"""The commands of DJI's plaintext protocol and their arguments, as its page ``protocol_api`` documents them.

Arguments with a name may come in any order; those without one follow the words of their command. A query ends with a
question mark.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from triform.robots.robomaster import protocol

#: What chassis and gimbal can be to each other.
MODES = ("chassis_lead", "gimbal_lead", "free")
SWITCH = ("on", "off")


@dataclass(frozen=True)
class Number:
    """An argument that is a number.

    Attributes:
        low: Smallest value.
        high: Largest value.
        whole: Whether it is an integer.
        base: Base of an integer.
    """

    low: float
    high: float
    whole: bool = False
    base: int = 10

    def read(self, word: str) -> float:
        """Return the value of a word.

        Raises:
            ValueError: It is no such number, or outside the limits.
        """
        value = int(word, self.base) if self.whole else float(word)
        # A little slack: the limits of turn rates are rounded in other units.
        if not self.low - 1e-9 <= value <= self.high + 1e-9:
            raise ValueError(f"{word} is not within {self.low} to {self.high}")
        return value


Argument = Number | tuple[str, ...]


class ParseError(ValueError):
    """Words that are no command of the protocol."""


@dataclass(frozen=True)
class Form:
    """What follows the words of a command.

    Attributes:
        plain: Arguments without a name, in their order.
        named: Arguments that each need their name before them, in any order.
        options: Further ones of that kind, which may be left out.
        any_of: At least one of these options is needed.
    """

    plain: tuple[Argument, ...] = ()
    named: Mapping[str, Argument] = field(default_factory=dict)
    options: Mapping[str, Argument] = field(default_factory=dict)
    any_of: tuple[str, ...] = ()

    def read(self, words: list[str]) -> dict[str, float | str]:
        """Return arguments by name, those without one by their number.

        Raises:
            ParseError: Arguments are missing, unknown or there twice, or no word that is known.
            ValueError: A number is none, or outside its limits.
        """
        plain, rest = words[: len(self.plain)], words[len(self.plain) :]
        names = rest[::2]
        known = {**self.named, **self.options}
        given = set(names)
        if (
            len(plain) < len(self.plain)
            or len(rest) % 2
            or len(given) < len(names)
            or not self.named.keys() <= given <= known.keys()
            or (self.any_of and not given & set(self.any_of))
        ):
            raise ParseError(" ".join(words))
        arguments = {
            **{str(k): (word, self.plain[k]) for k, word in enumerate(plain)},
            **{name: (word, known[name]) for name, word in zip(names, rest[1::2], strict=True)},
        }
        return {name: _value(word, kind) for name, (word, kind) in arguments.items()}


def _value(word: str, kind: Argument) -> float | str:
    if isinstance(kind, Number):
        return kind.read(word)
    if word not in kind:
        raise ParseError(word)
    return word


_SPEED = Number(-protocol.MAX_SPEED, protocol.MAX_SPEED)
_TURN = math.degrees(protocol.MAX_TURN_RATE)
_WHEEL = Number(-protocol.MAX_WHEEL_RATE, protocol.MAX_WHEEL_RATE, whole=True)
_COLOUR = Number(0, 255, whole=True)
_PORTS = Number(0, 0xFFFF, whole=True, base=16)
_ADAPTER = Form(named={"id": Number(1, 6, whole=True), "port": Number(1, 2, whole=True)})
_SERVO = Number(1, 3, whole=True)
_LEVEL = Number(1, 4, whole=True)
_RATE = tuple(map(str, protocol.PUSH_RATES))
_LIGHTS = (
    "all", "top_all", "top_right", "top_left", "bottom_all", "bottom_front", "bottom_back", "bottom_left",
    "bottom_right",
)  # fmt: skip
_ARM = Form(named={"x": Number(-1000, 1000), "y": Number(-1000, 1000)})
_TILT = {"vp": Number(0, 540), "vy": Number(0, 540)}

#: Commands but ``command`` and ``chassis push``, whose settings have a grammar of their own, by their words.
COMMANDS = {
    "quit": Form(),
    "robot mode": Form((MODES,)),
    "chassis speed": Form(named={"x": _SPEED, "y": _SPEED, "z": Number(-_TURN, _TURN)}),
    "chassis wheel": Form(named=dict.fromkeys(("w1", "w2", "w3", "w4"), _WHEEL)),
    "chassis move": Form(
        options={
            "x": Number(-5, 5),
            "y": Number(-5, 5),
            "z": Number(-1800, 1800),
            "vxy": Number(1e-6, protocol.MAX_SPEED),
            "vz": Number(1e-6, _TURN),
        },
        any_of=("x", "y", "z"),
    ),
    "gimbal speed": Form(named={"p": Number(-450, 450), "y": Number(-450, 450)}),
    "gimbal move": Form(options={"p": Number(-55, 55), "y": Number(-55, 55), **_TILT}, any_of=("p", "y")),
    "gimbal moveto": Form(options={"p": Number(-25, 30), "y": Number(-250, 250), **_TILT}, any_of=("p", "y")),
    "gimbal suspend": Form(),
    "gimbal resume": Form(),
    "gimbal recenter": Form(),
    "gimbal push": Form(named={"attitude": SWITCH}, options={"afreq": _RATE}),
    "blaster bead": Form((Number(1, 5, whole=True),)),
    "blaster fire": Form(),
    "armor sensitivity": Form((Number(1, 10, whole=True),)),
    "armor event": Form((("hit",), SWITCH)),
    "sound event": Form((("applause",), SWITCH)),
    "pwm value": Form((_PORTS, Number(0, 100))),
    "pwm freq": Form((_PORTS, Number(0, math.inf, whole=True))),
    "led control": Form(
        named={
            "comp": _LIGHTS,
            "r": _COLOUR,
            "g": _COLOUR,
            "b": _COLOUR,
            "effect": ("solid", "off", "pulse", "blink", "scrolling"),
        }
    ),
    "sensor_adapter event": Form((("io_level",), SWITCH)),
    "ir_distance_sensor measure": Form((SWITCH,)),
    "servo angle": Form(named={"id": _SERVO, "angle": Number(-180, 180)}),
    "servo speed": Form(named={"id": _SERVO, "speed": Number(-1800, 1800)}),
    "servo stop": Form(),
    "robotic_arm move": _ARM,
    "robotic_arm moveto": _ARM,
    "robotic_arm recenter": Form(),
    "robotic_arm stop": Form(),
    "robotic_gripper open": Form(options={"leve": _LEVEL}),
    "robotic_gripper close": Form(options={"leve": _LEVEL}),
    **{f"{stream} {switch}": Form() for stream in ("stream", "audio") for switch in SWITCH},
}

#: Queries by their words. The page writes the one for pulses without a question mark.
QUERIES = {
    **{f"robot {what}": Form() for what in ("mode", "battery")},
    **{f"chassis {what}": Form() for what in ("speed", "position", "attitude", "status")},
    "gimbal attitude": Form(),
    "blaster bead": Form(),
    "armor sensitivity": Form(),
    **{f"sensor_adapter {what}": _ADAPTER for what in ("adc", "io_level", "pulse_period")},
    "ir_distance_sensor distance": Form((Number(1, 4, whole=True),)),
    "servo angle": Form(named={"id": _SERVO}),
    "robotic_arm position": Form(),
    "robotic_gripper status": Form(),
}


class Equipment:
    """What a RoboMaster has besides a chassis: it takes every command at once, and queries give it back."""

    def __init__(self) -> None:
        """Begin as the robot is when it is switched on."""
        self.gimbal = [0.0, 0.0]
        self._arm = [0.0, 0.0]
        self._servos = [0.0, 0.0, 0.0]
        self._bead, self._sensitivity, self._gripper = 1, 5, 1

    def obey(self, command: str, given: dict[str, float | str]) -> None:
        """Follow a command that is not the chassis's."""
        values = {name: value for name, value in given.items() if not isinstance(value, str)}
        match command:
            case "gimbal move":
                self.gimbal = [now + values.get(axis, 0.0) for now, axis in zip(self.gimbal, "py", strict=True)]
            case "gimbal moveto":
                self.gimbal = [values.get(axis, now) for now, axis in zip(self.gimbal, "py", strict=True)]
            case "gimbal recenter":
                self.gimbal = [0.0, 0.0]
            case "blaster bead":
                self._bead = int(values["0"])
            case "armor sensitivity":
                self._sensitivity = int(values["0"])
            case "servo angle":
                self._servos[int(values["id"]) - 1] = values["angle"]
            case "robotic_arm move":
                self._arm = [self._arm[0] + values["x"], self._arm[1] + values["y"]]
            case "robotic_arm moveto":
                self._arm = [values["x"], values["y"]]
            case "robotic_arm recenter":
                self._arm = [0.0, 0.0]
            case "robotic_gripper open":
                self._gripper = 2
            case "robotic_gripper close":
                self._gripper = 0

    def answer(self, query: str, given: dict[str, float | str]) -> str:
        """Return the answer to a query that is not the chassis's; sensors that are not there measure 0."""
        match query:
            case "gimbal attitude":
                return spaced(self.gimbal)
            case "blaster bead":
                return str(self._bead)
            case "armor sensitivity":
                return str(self._sensitivity)
            case "servo angle":
                return spaced([self._servos[int(given["id"]) - 1]])
            case "robotic_arm position":
                return spaced(self._arm)
            case "robotic_gripper status":
                return str(self._gripper)
        return "0"


def spaced(numbers: list[float]) -> str:
    """Return numbers as the robot sends them."""
    return " ".join(f"{number:.3f}" for number in numbers)
