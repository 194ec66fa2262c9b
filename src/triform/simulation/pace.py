"""How fast a robot may be for how late it knows: the pace of its commands and of its exploration noise.

Let a robot follow springs of gain k to n neighbours. Along one axis they hold it with ``K = k n / 2``; it knows its own
position now, from its odometry, and theirs late. A command that it holds for P moves it by ``-K P`` of its way from
where they seemed to be. If ``K P <= 1``, its new place is a mean of its own and theirs, whatever moment theirs are of,
so no disturbance grows; with six neighbours and a gain of 3/s that is ``P <= 1/9 s``. Odd springs push across what
robots saw a while ago, so with them the age of what is known has a bound as well: the eigenvalues of a late lattice
give about 0.35 s. Both bounds are on a gain times a time, so a robot that is late drives at a share of the speed that
its controller wants, which makes every gain smaller by that share.

A team in which all keep one pace runs the same course in slower time. So noise lasts as much longer as it is smaller.
The first bound is that of a single robot: in a team of several paces each may keep its own.
"""

from __future__ import annotations

from triform.simulation.profiles import Profile

#: Longest hold of a command at full pace [s]: that of the hardware profile, at which teams still come to rest.
_LONGEST_HOLD = 0.125
#: Greatest mean age of what is known of others at full pace [s]; that of all shipped profiles is less.
_GREATEST_AGE = 0.35


def pace(profile: Profile) -> float:
    """Return the share of a controller's speeds that a robot drives, 1 unless it knows late.

    The mean age is the latency, half the time between two scans, half that for which a command is held, and half a turn
    of a rolling scan.

    Args:
        profile: The robot.
    """
    lidar, hold = profile.lidar, profile.control_period
    age = profile.latency + (1.0 if lidar.rolling else 0.5) * lidar.period + 0.5 * hold
    return min(1.0, _LONGEST_HOLD / hold, _GREATEST_AGE / age)
