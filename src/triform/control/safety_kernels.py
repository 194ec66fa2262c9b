"""Compiled speed limits from a scan: gaps, half-planes of allowed velocities, and the nearest allowed velocity."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from triform.geometry.unicycle import Wheels, roll
from triform.kernels import kernel
from triform.types import Body

#: Sine of the angle below which two lines count as parallel.
_PARALLEL = 1e-9


class SafetyRules(NamedTuple):
    """What limits a command.

    Attributes:
        directions: Unit vectors of the rays in the robot's frame, shape (R, 2).
        range_min: Of the LiDAR [m].
        range_max: Of the LiDAR [m].
        body: Outline of all robots.
        circumradius: Of that outline [m].
        rate: Speed allowed towards a return, per gap beyond ``min_gap`` [1/s].
        min_gap: Gap that robots keep [m].
        max_speed: The drive shortens faster commands to this speed [m/s].
        max_axis_speed: Then it clips both axes by themselves [m/s].
        pace: Share of a command that is driven.
    """

    directions: Any
    range_min: float
    range_max: float
    body: Body
    circumradius: float
    rate: float
    min_gap: float
    max_speed: float
    max_axis_speed: float
    pace: float


class Arcs(NamedTuple):
    """What a differential base does between a decision and its effect.

    Attributes:
        wheels: Limits of the base.
        hold: How long a commanded turn goes on before another command has taken its place [s].
        slack: Largest angle between the heading at rest, from which a command is judged, and that in which an earlier
            command is still driven [rad].
    """

    wheels: Wheels
    hold: float
    slack: float


@kernel
def gap_along(distance, cos, sin, body):
    """Gap between a robot's own outline and a return.

    Args:
        distance: Range of the return [m].
        cos: Direction of its ray in the robot's frame, x.
        sin: The same, y.
        body: Outline of the robot, ``Body``.

    Returns:
        The gap [m], negative inside the outline, and the unit vector along which it is measured, from the outline
        to the return. Inside the outline that is the direction of the ray.
    """
    half_length, half_width, is_circle = body
    if is_circle:
        return distance - half_length, cos, sin
    x, y = distance * cos, distance * sin
    out_x, out_y = abs(x) - half_length, abs(y) - half_width
    if out_x <= 0.0 and out_y <= 0.0:
        return max(out_x, out_y), cos, sin
    sign_x, sign_y = np.sign(x), np.sign(y)
    if out_y <= 0.0:
        return out_x, sign_x, 0.0
    if out_x <= 0.0:
        return out_y, 0.0, sign_y
    gap = np.sqrt(out_x * out_x + out_y * out_y)
    return gap, sign_x * out_x / gap, sign_y * out_y / gap


@kernel
def nearest_allowed(u_x, u_y, planes, count):
    """The velocity nearest to a wanted one within half-planes that all hold the origin.

    Planes are added one by one. If one forbids the best velocity so far, the best one now lies on its line, at the
    place nearest to the wanted velocity that the planes before leave free. That place exists: the way from the best
    velocity so far to zero, both allowed by the planes before, crosses the line. Where rounding hides it (planes
    that leave a single line or point), the crossing itself is taken. As zero is allowed, the result is never longer
    than the wanted velocity.

    Args:
        u_x: Wanted velocity, x [m/s].
        u_y: The same, y [m/s].
        planes: Unit normal (2) and bound, not negative [m/s], of every half-plane ``normal . u <= bound``, shape
            (>= count, 3).
        count: Number of half-planes.

    Returns:
        The velocity (x, y) [m/s]; the wanted one itself if it is allowed.
    """
    x, y = u_x, u_y
    for i in range(count):
        n_x, n_y, bound = planes[i, 0], planes[i, 1], planes[i, 2]
        speed = n_x * x + n_y * y
        if speed <= bound:
            continue
        low, high = -np.inf, np.inf
        for j in range(i):
            slope = n_x * planes[j, 1] - n_y * planes[j, 0]
            slack = planes[j, 2] - bound * (n_x * planes[j, 0] + n_y * planes[j, 1])
            if slope > _PARALLEL:
                high = min(high, slack / slope)
            elif slope < -_PARALLEL:
                low = max(low, slack / slope)
        if low > high:
            x, y = x * (bound / speed), y * (bound / speed)
        else:
            along = min(max(n_x * u_y - n_y * u_x, low), high)
            x, y = bound * n_x - along * n_y, bound * n_y + along * n_x
    return x, y


@kernel
def _measured(value, range_min, range_max):
    """Range of a ray [m]: ``-inf`` is ``range_min``; no return and no measurement are ``inf``."""
    if 0.0 < value <= range_max:
        return value
    return range_min if value == -np.inf else np.inf


@kernel
def _confirmed(ranges, k, range_min, range_max):
    """Median range of a ray and its two neighbours [m]: what a single ray shows is not believed."""
    total = ranges.shape[0]
    left = _measured(ranges[k - 1], range_min, range_max)
    own = _measured(ranges[k], range_min, range_max)
    right = _measured(ranges[k + 1 if k + 1 < total else 0], range_min, range_max)
    return max(min(left, own), min(max(left, own), right))


@kernel
def _driven(u_x, u_y, guard):
    """What the drive makes of a velocity: shortened to a largest speed, then each axis clipped [m/s]."""
    max_speed, max_axis_speed = guard.max_speed, guard.max_axis_speed
    speed = np.sqrt(u_x * u_x + u_y * u_y)
    if speed > max_speed:
        u_x, u_y = u_x * (max_speed / speed), u_y * (max_speed / speed)
    return min(max(u_x, -max_axis_speed), max_axis_speed), min(max(u_y, -max_axis_speed), max_axis_speed)


@kernel
def _is_blind(ranges, early):
    """Whether a scan tells nothing: it has no measurement, or, ``early`` in a run, no return."""
    for k in range(ranges.shape[0]):
        value = ranges[k]
        if value == -np.inf or 0.0 < value < np.inf or (value == np.inf and not early):
            return False
    return True


@kernel
def _find_planes(ranges, guard, body, speed, planes):
    """Write the half-planes that can forbid a velocity of norm ``speed``; return their number and the least gap [m]."""
    directions, range_min, range_max = guard.directions, guard.range_min, guard.range_max
    rate, min_gap = guard.rate, guard.min_gap
    reach = guard.circumradius + min_gap + speed / rate
    count, least = 0, np.inf
    for k in range(ranges.shape[0]):
        distance = _confirmed(ranges, k, range_min, range_max)
        if distance >= reach:
            continue
        gap, n_x, n_y = gap_along(distance, directions[k, 0], directions[k, 1], body)
        least = min(least, gap)
        bound = rate * max(gap - min_gap, 0.0)
        if bound < speed:
            planes[count, 0], planes[count, 1], planes[count, 2] = n_x, n_y, bound
            count += 1
    return count, least


@kernel
def filter_robots(ranges, active, guard, early, commands, first, last):
    """Slow down to their pace and limit the commands of the robots ``first <= m < last`` in place.

    Args:
        ranges: Newest scans [m], shape (M, R).
        active: Robots that exist, shape (M,).
        guard: ``SafetyRules``.
        early: Whether scans may still be missing because the run has just begun.
        commands: Body twists, shape (M, 3) [m/s, m/s, rad/s].
        first: First robot.
        last: One behind the last.
    """
    circle = Body(guard.circumradius, guard.circumradius, True)
    planes = np.empty((ranges.shape[1] + 4, 3))
    for m in range(first, last):
        for part in range(3):
            commands[m, part] *= guard.pace
        turning = commands[m, 2] != 0.0
        u_x, u_y = _driven(commands[m, 0], commands[m, 1], guard)
        speed = np.sqrt(u_x * u_x + u_y * u_y)
        if not active[m] or (speed == 0.0 and not turning):
            continue
        if _is_blind(ranges[m], early):
            commands[m] = 0.0
            continue
        count, least = _find_planes(ranges[m], guard, circle if turning else guard.body, speed, planes)
        if turning and least <= 0.0:
            commands[m, 2] = 0.0
        if count == 0:
            continue
        if guard.max_axis_speed < np.inf:
            for side in range(4):
                planes[count, 0] = (1.0, -1.0, 0.0, 0.0)[side]
                planes[count, 1] = (0.0, 0.0, 1.0, -1.0)[side]
                planes[count, 2] = guard.max_axis_speed
                count += 1
        x, y = nearest_allowed(u_x, u_y, planes, count)
        if x != u_x or y != u_y:
            commands[m, 0], commands[m, 1] = x, y


@kernel
def _slowest_of_returns(ranges, guard, arcs, resting, along, turn):
    """Speed to which returns limit a robot that wants to roll ``along`` while it turns; least gap [m]; limiting ray.

    Of a return, what counts is how far it is from where the robot would come to rest, and how straight the robot may
    come to drive at it: its bearing from the direction of travel, less all that the robot turns meanwhile.
    """
    limit, least, limiting = abs(along), np.inf, -1
    ahead = 1.0 if along >= 0.0 else -1.0
    turning = arcs.slack + abs(turn) * arcs.hold
    cos, sin = np.cos(resting[2]), np.sin(resting[2])
    reach = guard.circumradius + guard.min_gap + limit / guard.rate + np.hypot(resting[0], resting[1])
    for k in range(ranges.shape[0]):
        distance = _confirmed(ranges, k, guard.range_min, guard.range_max)
        if distance >= reach:
            continue
        x, y = distance * guard.directions[k, 0] - resting[0], distance * guard.directions[k, 1] - resting[1]
        gap = np.hypot(x, y) - guard.circumradius
        least = min(least, gap)
        off = np.arctan2(abs(cos * y - sin * x), ahead * (cos * x + sin * y)) - turning
        if off < 0.5 * np.pi:
            bound = guard.rate * max(gap - guard.min_gap, 0.0) / np.cos(max(off, 0.0))
            if bound < limit:
                limit, limiting = bound, k
    return limit, least, limiting


@kernel
def filter_rolling(ranges, active, guard, arcs, early, resting, commands, first, last):
    """Turn commands of differential bases into a speed and a turn rate at their pace, in place, and limit the speed.

    Args:
        ranges: Newest scans [m], shape (M, R).
        active: Robots that exist, shape (M,).
        guard: ``SafetyRules``; the outline is the circle around it.
        arcs: ``Arcs``.
        early: Whether scans may still be missing because the run has just begun.
        resting: Odometry, shape (M, 3) [m, m, rad]; zeros where there is none.
        commands: Body twists, shape (M, 3) [m/s, m/s, rad/s].
        first: First robot.
        last: One behind the last.
    """
    for m in range(first, last):
        along, turn = roll(commands[m, 0], commands[m, 1], commands[m, 2], arcs.wheels)
        along, turn = guard.pace * along, guard.pace * turn
        if active[m] and (along != 0.0 or turn != 0.0):
            if _is_blind(ranges[m], early):
                along, turn = 0.0, 0.0
            else:
                limit, least, _ = _slowest_of_returns(ranges[m], guard, arcs, resting[m], along, turn)
                along = min(max(along, -limit), limit)
                if least <= 0.0 and not guard.body.is_circle:
                    turn = 0.0
        commands[m, 0], commands[m, 1], commands[m, 2] = along, 0.0, turn


@kernel
def free_speeds_into(ranges, guard, early, turning, angles, speeds, limiting):
    """Write how fast a holonomic robot may go straight along each angle, up to the speeds given.

    Args:
        ranges: Newest scan [m], shape (R,).
        guard: ``SafetyRules``.
        early: Whether the scan may still be missing because the run has just begun.
        turning: Whether the robot turns meanwhile.
        angles: Directions in the robot's frame [rad], shape (K,).
        speeds: Largest speeds that are of interest [m/s], shape (K,); overwritten by what is allowed of them.
        limiting: To fill: the ray whose return limits the speed, -1 for none, shape (K,).
    """
    limiting[:] = -1
    if _is_blind(ranges, early):
        speeds[:] = 0.0
        return
    body = Body(guard.circumradius, guard.circumradius, True) if turning else guard.body
    for k in range(ranges.shape[0]):
        distance = _confirmed(ranges, k, guard.range_min, guard.range_max)
        if distance == np.inf:
            continue
        gap, n_x, n_y = gap_along(distance, guard.directions[k, 0], guard.directions[k, 1], body)
        bound = guard.rate * max(gap - guard.min_gap, 0.0)
        for j in range(angles.shape[0]):
            towards = n_x * np.cos(angles[j]) + n_y * np.sin(angles[j])
            if speeds[j] * towards > bound:
                speeds[j], limiting[j] = bound / towards, k


@kernel
def free_rolling_into(ranges, guard, arcs, early, resting, turn, speeds, limiting):
    """As ``free_speeds_into`` for a differential base that turns: ``speeds`` forwards and backwards, shape (2,)."""
    limiting[:] = -1
    if _is_blind(ranges, early):
        speeds[:] = 0.0
        return
    for j in range(2):
        along = speeds[j] if j == 0 else -speeds[j]
        speeds[j], _, limiting[j] = _slowest_of_returns(ranges, guard, arcs, resting, along, turn)
