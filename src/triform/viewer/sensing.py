"""What one robot sees: its scan in the world, its occupancy map, what it makes of them, and what it may do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triform.control import ControllerSpec, bright_returns, free_velocities
from triform.evaluation.filters import team_settings
from triform.evaluation.scenario import Scenario
from triform.figures.sensing import place_returns
from triform.mixed import MixedView
from triform.types import FloatArray, PrivilegedView
from triform.viewer.reading import Reading, policy_reader

#: Faster velocities are not drawn [m/s].
_FASTEST = 1.0
#: Of slow robots, full speed is drawn this long [m].
_LONGEST = 0.5


@dataclass(frozen=True, eq=False)
class Sensing:
    """What a robot sees, and its command.

    Attributes:
        pose: Where it is [m, m, rad], shape (3,).
        hits: Returns of its LiDAR in the world frame [m], shape (K, 2).
        reach: How far its LiDAR looks [m].
        reading: What the policy makes of its scan; ``None`` where that can make no map of it.
        wanted: The body twist that its controller wants [m/s, m/s, rad/s], shape (3,).
        command: That which the guard allows of it, shape (3,).
        free: Edge of the velocities that the safety filter allows, in the robot's frame [m/s], shape (L, 2): all
            around, or forwards and backwards of a differential base; ``None`` without the filter.
        limiting: Returns that limit them, in the world frame [m], shape (J, 2).
        horizon: Velocities are drawn as the ways of this time [s].
    """

    pose: FloatArray
    hits: FloatArray
    reach: float
    reading: Reading | None
    wanted: FloatArray
    command: FloatArray
    free: FloatArray | None
    limiting: FloatArray
    horizon: float


def sense(
    view: PrivilegedView,
    wanted: FloatArray,
    commands: FloatArray,
    robot: int,
    controller: ControllerSpec,
    scenario: Scenario,
) -> Sensing:
    """Return what one robot of the first world sees.

    Args:
        view: What the team sees.
        wanted: Body twists that the controller wants, shape (B, N, 3).
        commands: Those that the guard allows, shape (B, N, 3).
        robot: Index of the robot along axis N.
        controller: Who steers; the map is that of its policy, or of the default one.
        scenario: Everything else about the run.
    """
    part, kind, index = view, 0, robot
    if isinstance(view, MixedView):
        kind, index = view.part_of(robot)
        part = view.parts[kind]
    _, returned, places = place_returns(part, index)
    drive = scenario.team.profiles[kind].drive
    free, limiting = None, np.zeros(0, dtype=np.int64)
    if scenario.guard == "filter":
        rules = team_settings(scenario.driven)[kind]
        # A differential base turns towards what a holonomic one would do: its filter sees that turn.
        turn = float((wanted if rules.arcs is None else commands)[0, robot, 2])
        free, by = free_velocities(part, index, rules, turn, _FASTEST)
        limiting = np.unique(by[by >= 0])
    return Sensing(
        np.array(part.poses[0, index]),
        places[returned],
        part.scans.config.range_max,
        _read(part, index, controller, scenario, kind),
        np.array(wanted[0, robot]),
        np.array(commands[0, robot]),
        free,
        places[limiting[returned[limiting]]],
        max(1.0, _LONGEST / min(drive.max_speed, drive.max_axis_speed, _FASTEST)),
    )


def _read(
    part: PrivilegedView, index: int, controller: ControllerSpec, scenario: Scenario, kind: int
) -> Reading | None:
    """Return what the policy makes of a robot's scan."""
    steers = controller.name == "policy"
    scans, threshold = part.scans, scenario.team.profiles[kind].lidar.min_intensity
    if steers and threshold is not None:
        scans = bright_returns(scans, threshold)
    odometry = None if part.odometry is None else np.array(part.odometry[0, index])
    reader = policy_reader(controller.weights if steers else None)
    ranges = np.asarray(scans.ranges[0, index], dtype=np.float64)
    return reader.read(ranges, odometry, scans.config, scenario.distance, steers)
