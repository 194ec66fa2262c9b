"""Scans, poses, body twists and the two interfaces that carry everything.

Conventions (REP 103, REP 117): metres, seconds, radians; x forward, y left, counter-clockwise positive;
``+inf`` no return, ``-inf`` too close, ``NaN`` no valid measurement.

Array axes, everywhere: ``B`` worlds, ``N`` robots, ``R`` rays, ``H W`` cells, ``T`` steps, ``P`` patches,
``D`` embedding. A single robot is the case ``B = N = 1``.

A *pose* is ``(x, y, heading)`` in the world frame [m, m, rad]; a *body twist*, or *command*, is
``(u_x, u_y, omega)`` in the robot's own frame [m/s, m/s, rad/s].
"""

from __future__ import annotations

import difflib
import functools
import itertools
import numbers
import os
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
#: Ranges of scans [m], of any floating type; the built-in world's are float32, as those of ``sensor_msgs/LaserScan``.
RangeArray = NDArray[Any]
IntArray = NDArray[np.int64]
#: Occupancy maps: 1 where something is, 0 elsewhere; axis H grows with x (forward), axis W with y (left).
MapArray = NDArray[np.uint8]

#: Reach of the paper's LiDAR: how far one robot sees another [m], for a prescribed distance of 1 m.
SENSING_RANGE = 2.0
#: How far robots look where nothing else is said [d*]: what the triangulating law is tuned for.
SIGHT = 3.0
#: No robot is so far away, has come so far, or is noised so much [m].
LARGEST = 1e6
#: How long a robot holds its exploration noise before it draws anew [s].
NOISE_PERIOD = 0.5


#: What a value of a type is called in errors.
_NEEDED = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", Path: "a path"}

Value = TypeVar("Value")


def printable(text: str) -> str:
    """Return text that others wrote as a terminal may show it: what is no printable character becomes its escape.

    Names of files, answers of a robot, the log of another program and the like can hold sequences that steer a
    terminal, ends of lines, or characters that no encoding has.
    """
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


class TriformError(Exception):
    """Something the user gave or the machine did is wrong; the message says what in one sentence, all printable."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ConfigurationError(TriformError, ValueError):
    """A configuration value is outside what is allowed."""


def require(condition: bool, message: str) -> None:
    """Refuse a configuration: raise ``ConfigurationError(message)`` unless ``condition`` holds."""
    if not condition:
        raise ConfigurationError(message)


def choose(kind: str, name: str, table: Mapping[str, Value], otherwise: str = "") -> Value:
    """Return the value called ``name``.

    Args:
        kind: What is looked up, such as profile.
        name: Its name.
        table: Values by name.
        otherwise: What else would be accepted, such as a TOML file.

    Raises:
        ConfigurationError: There is none of that name; the sentence says which there are.
    """
    if name in table:
        return table[name]
    raise ConfigurationError(
        f"there is no {kind} {name!r}{nearest(name, table)}; there are {', '.join(table)}{otherwise}"
    )


def nearest(name: str, known: Collection[str]) -> str:
    """Return a question for the nearest known name; empty if none is near."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def as_array(what: str, values: ArrayLike, dtype: type[np.generic] | None = np.float64) -> NDArray[Any]:
    """Return values as kernels take them: in memory order, of the machine's byte order, writable.

    Args:
        what: What they are called in an error, such as positions.
        values: Numbers of any real type, in an array or in lists; for ``bool``, truth values alone.
        dtype: Type of the result; ``None`` keeps single precision and makes all else double precision.

    Returns:
        The values themselves if they are so already, else a copy.

    Raises:
        ConfigurationError: The values are of another kind, some are masked, or rows have several lengths.
    """
    dtypes = (np.float32, np.float64) if dtype is None else (dtype,)
    # One number may stand for all rays that have not been measured yet.
    spread = dtype is None and isinstance(values, np.ndarray) and 0 in values.strides
    if type(values) is np.ndarray and values.dtype in dtypes and (values.flags.carray or spread):
        return values
    try:
        array = np.asarray(values)
    except (ValueError, TypeError):
        raise ConfigurationError(
            f"the {what} are rows of several lengths, or no numbers; they need one length"
        ) from None
    allowed, needed = ("b", "true or false") if dtype is np.bool_ else ("iuf", "numbers")
    if array.dtype.kind not in allowed:
        raise ConfigurationError(f"the {what} are of type {array.dtype}; {needed} are needed")
    if np.ma.is_masked(values):
        raise ConfigurationError(f"some of the {what} are masked; every one needs a value")
    single = len(dtypes) > 1 and array.dtype.newbyteorder("=") == np.float32
    # What no double holds is infinite.
    with np.errstate(over="ignore"):
        return np.require(array, dtypes[0 if single else -1], ["C", "A", "W"])


def convert_fields(configuration: Any) -> None:
    """Give every value of a frozen dataclass the type that its attribute declares; call it in ``__post_init__``.

    Raises:
        ConfigurationError: A value is of another type, see ``converted``.
    """
    for name, kind in _declared(configuration.__class__).items():
        object.__setattr__(configuration, name, converted(name, getattr(configuration, name), kind))


@functools.cache
def _declared(configuration: Any) -> dict[str, Any]:
    """Types of a dataclass's attributes by name."""
    hints = get_type_hints(configuration)
    return {each.name: hints[each.name] for each in fields(configuration)}


def converted(name: str, value: Any, kind: Any) -> Any:
    """Return a value as a type, where that has one meaning.

    Numbers of NumPy become those of Python, text becomes a path and a path text, lists and arrays become tuples.

    Args:
        name: What the value is called in an error.
        value: The value.
        kind: ``bool``, ``int``, ``float``, ``str``, ``Path``, a dataclass, one of these or ``None``, or a tuple of
            these; values of other types are left as they are.

    Raises:
        ConfigurationError: The value is of another type; the sentence says of which one is needed.
    """
    if type(value) is kind:
        return value
    fits, make, inner = False, kind, get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        rest = [each for each in inner if each is not NoneType]
        return value if value is None or len(rest) > 1 else converted(name, value, rest[0])
    if get_origin(kind) is tuple:
        kinds = itertools.repeat(inner[0]) if inner[1:] == (...,) else inner
        if isinstance(value, list | tuple | np.ndarray) and (inner[1:] == (...,) or len(value) == len(inner)):
            return tuple(converted(name, each, one) for each, one in zip(value, kinds, strict=False))
        raise ConfigurationError(f"{name} is {value!r}; a list is needed")
    if isinstance(value, bool | np.bool_):
        fits, make = kind is bool, bool
    elif isinstance(value, numbers.Integral):
        fits, make = kind is int or (kind is float and abs(int(value)) <= sys.float_info.max), int
    elif isinstance(value, numbers.Real):
        fits, make = kind is float, float
    elif isinstance(value, str | os.PathLike):
        fits, make = kind in (str, Path), kind
    if fits:
        return make(value)
    if kind in _NEEDED or (isinstance(kind, type) and is_dataclass(kind) and not isinstance(value, kind)):
        raise ConfigurationError(f"{name} is {value!r}; {_NEEDED.get(kind) or f'a {kind.__name__}'} is needed")
    return value


class Body(NamedTuple):
    """Outline of all robots, as kernels take it.

    Attributes:
        half_length: Half the length of a box along x, or the radius of a circle [m].
        half_width: Half the width of a box along y, or the radius again [m].
        is_circle: Whether robots are circles rather than boxes.
    """

    half_length: float
    half_width: float
    is_circle: bool


@dataclass(frozen=True)
class ScanConfig:
    """Shape of one LiDAR turn, with the names of ``sensor_msgs/LaserScan``.

    Attributes:
        rays: Number of rays of a full turn, evenly spaced.
        angle_min: Angle of the first ray in the robot's frame [rad].
        range_min: Nearer returns are ``-inf`` [m].
        range_max: Farther returns are ``+inf`` [m].
    """

    rays: int = 450
    angle_min: float = -np.pi
    range_min: float = 0.02
    range_max: float = SENSING_RANGE

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.rays >= 1, f"rays is {self.rays}; at least 1 is needed")
        require(bool(np.isfinite(self.angle_min)), f"angle_min is {self.angle_min}; it must be finite")
        require(
            0 <= self.range_min < self.range_max < np.inf,
            f"range_min {self.range_min} m and range_max {self.range_max} m must satisfy "
            "0 <= range_min < range_max < inf",
        )

    @property
    def angle_increment(self) -> float:
        """Angle between neighbouring rays [rad], counter-clockwise."""
        return 2 * np.pi / self.rays

    @property
    def angles(self) -> FloatArray:
        """Angle of every ray in the robot's frame [rad], shape (R,)."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.rays), dtype=np.float64)


@dataclass(frozen=True)
class MapConfig:
    """Occupancy map of Algorithm 3: a square grid with the robot at its centre.

    Attributes:
        size: Cells along each side.
        cell: Side of one cell [m].
        min_cells: Connected groups with fewer cells are noise and dropped.
        max_cells: Connected groups with more cells are walls and dropped.
    """

    size: int = 100
    cell: float = 0.04
    min_cells: int = 12
    max_cells: int = 150

    def __post_init__(self) -> None:
        convert_fields(self)
        require(self.size >= 1, f"map size is {self.size} cells; at least 1 is needed")
        require(0 < self.cell < np.inf, f"cell is {self.cell} m; it must be positive and finite")
        require(
            0 <= self.min_cells <= self.max_cells,
            f"min_cells {self.min_cells} and max_cells {self.max_cells} must satisfy 0 <= min_cells <= max_cells",
        )

    @property
    def half_extent(self) -> float:
        """Distance from the robot to the map's edge along an axis [m]."""
        return self.size * self.cell / 2


@dataclass(frozen=True)
class Scan:
    """LiDAR scans of many robots that share one configuration.

    Attributes:
        ranges: Measured ranges [m], shape (..., R); REP 117 for what is no range.
        config: Angles and limits of the scan.
        intensities: How bright every return is, shape (..., R), in the LiDAR's own scale as in ``LaserScan``; 0 to 255
            for LDROBOT's. Without meaning where nothing returned; ``None`` where the LiDAR does not say.
    """

    ranges: RangeArray
    config: ScanConfig
    intensities: RangeArray | None = None

    def __post_init__(self) -> None:
        converted("config of a scan", self.config, ScanConfig)
        ranges = as_array("ranges of a scan", self.ranges, None)
        object.__setattr__(self, "ranges", ranges)
        if ranges.shape[-1:] != (self.config.rays,):
            raise ConfigurationError(
                f"a scan has ranges of shape {ranges.shape}; "
                f"its last axis must hold the {self.config.rays} rays of its configuration"
            )
        if self.intensities is not None:
            intensities = as_array("intensities of a scan", self.intensities, None)
            object.__setattr__(self, "intensities", intensities)
            require(
                intensities.shape == ranges.shape,
                f"a scan has intensities of shape {intensities.shape} and ranges of shape {ranges.shape}; they need "
                "one shape",
            )


@dataclass(frozen=True)
class View:
    """What a team senses at one moment.

    Attributes:
        scans: The newest finished scan of every robot, ranges of shape (B, N, R).
        active: Which robots exist, shape (B, N); the others' scans are ``+inf`` throughout.
        time: Time since the start of the run [s].
        noise: Two standard normal numbers of every robot's own seeded generator, drawn anew every ``NOISE_PERIOD``, for
            controllers that noise robots at random, shape (B, N, 2); smaller and longer for holonomic bases that are
            slower than 0.5 m/s. They last longer for robots that know late, too, and for differential bases, for which
            they also keep their direction in the world and have one size at all speeds. ``None`` where the team has no
            such generator.
        odometry: Wheel odometry: the pose of every robot in its own body frame at the moment that its scan shows
            [m, m, rad], shape (B, N, 3); of where it would come to rest if told to stop now, which for a base that
            stops at once is where it is. ``None`` where the team has no odometry.
    """

    scans: Scan
    active: BoolArray
    time: float
    noise: FloatArray | None = field(default=None, kw_only=True)
    odometry: FloatArray | None = field(default=None, kw_only=True)

    @classmethod
    def of_scan(
        cls,
        ranges: ArrayLike,
        config: ScanConfig | None = None,
        time: float = 0.0,
        intensities: ArrayLike | None = None,
    ) -> View:
        """Return the view of robots that have nothing but a scan.

        Args:
            ranges: Ranges [m] of one robot, shape (R,), of a team, (N, R), or of teams, (B, N, R); REP 117 for what is
                no range.
            config: Angles and limits of the scan; a full turn from -pi counter-clockwise up to 3 m if omitted.
            time: Time since the start of the run [s].
            intensities: How bright every return is, in the LiDAR's own scale, of the shape of the ranges; not known if
                omitted.

        Raises:
            ConfigurationError: The ranges or intensities are no numbers, or of another shape.
        """
        given = np.array(as_array("ranges of a scan", ranges))
        require(
            1 <= given.ndim <= 3 and given.size > 0,
            f"ranges of shape {given.shape} given; (R,), (N, R) or (B, N, R) is needed, with at least one ray",
        )
        batch = given.reshape((1,) * (3 - given.ndim) + given.shape)
        bright = None if intensities is None else np.array(as_array("intensities of a scan", intensities))
        require(
            bright is None or bright.shape == given.shape,
            f"intensities of shape {getattr(bright, 'shape', None)} given for ranges of shape {given.shape}; they need "
            "one shape",
        )
        scans = Scan(
            batch,
            ScanConfig(rays=batch.shape[-1], range_max=SIGHT) if config is None else config,
            None if bright is None else bright.reshape(batch.shape),
        )
        return cls(scans, np.ones(batch.shape[:2], dtype=np.bool_), time)

    def __post_init__(self) -> None:
        converted("scans of a view", self.scans, Scan)
        object.__setattr__(self, "time", converted("time of a view", self.time, float))
        object.__setattr__(self, "active", as_array("flags of active robots", self.active, np.bool_))
        shape = self.active.shape
        if len(shape) != 2 or self.scans.ranges.shape[:-1] != shape:
            raise ConfigurationError(
                f"a view has ranges of shape {self.scans.ranges.shape} and active of shape {shape}; "
                "(B, N, R) and (B, N) are needed"
            )
        for name, columns in (("noise", 2), ("odometry", 3)):
            if getattr(self, name) is not None:
                self._convert(name, columns)

    def _convert(self, name: str, columns: int) -> None:
        """Make an attribute an array with columns for every robot, or refuse it."""
        values, needed = as_array(f"{name} of a view", getattr(self, name)), (*self.active.shape, columns)
        require(values.shape == needed, f"a view has {name} of shape {values.shape}; {needed} is needed")
        require(
            is_plausible(values[self.active]),
            f"{name} of active robots must be finite and at most {LARGEST:g}; no command can rest on anything else",
        )
        object.__setattr__(self, name, values)


def is_plausible(values: FloatArray) -> bool:
    """Tell whether all values are finite and none exceeds ``LARGEST``, so that no law about them overflows."""
    return bool((np.abs(values) <= LARGEST).all())


@dataclass(frozen=True)
class PrivilegedView(View):
    """A view that also shows what no robot can know: everybody's pose.

    Attributes:
        poses: True poses (x, y, heading) in the world frame, shape (B, N, 3); ``NaN`` where not active.
    """

    poses: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        self._convert("poses", 3)

    def with_poses(self, poses: FloatArray) -> PrivilegedView:
        """Return the view with other poses, shape (B, N, 3) [m, m, rad]."""
        return replace(self, poses=poses)


ViewIn = TypeVar("ViewIn", bound=View, contravariant=True)
ViewOut = TypeVar("ViewOut", bound=View, covariant=True)


class Controller(Protocol[ViewIn]):
    """Turns what is seen into one body twist for every robot.

    ``Controller[View]`` uses scans alone and runs anywhere; ``Controller[PrivilegedView]`` needs true poses,
    so a type checker refuses it on a team that cannot offer them, and ``privileged`` says it at run time.
    """

    @property
    def privileged(self) -> bool:
        """Whether ``command`` needs a ``PrivilegedView``."""
        ...

    @property
    def description(self) -> dict[str, Any]:
        """Name and settings, plain JSON values, recorded with every result."""
        ...

    def command(self, view: ViewIn) -> FloatArray:
        """Return body twists, shape (B, N, 3); zero for robots that are not active."""
        ...


class Team(Protocol[ViewOut]):
    """A body of N robots in B independent worlds: the built-in world, a simulator, or one real robot."""

    @property
    def control_period(self) -> float:
        """Time between two commands [s]."""
        ...

    def observe(self) -> ViewOut:
        """Return what the team senses now."""
        ...

    def apply(self, commands: FloatArray, duration: float) -> None:
        """Hold body twists ``commands``, shape (B, N, 3), for ``duration`` seconds."""
        ...
