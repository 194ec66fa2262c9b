"""Exploration noise: two standard normal numbers for every robot and every half second, longer where robots must turn.

They are a function of the world's seed, the robot and the time alone, so that nothing has to be remembered, and what
one robot draws does not depend on how many others there are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from triform.kernels import kernel
from triform.simulation.profiles import Drive
from triform.types import NOISE_PERIOD, FloatArray

#: Speed of a base from which exploration noise has its full size [m/s].
_FULL_NOISE_SPEED = 0.5
#: Share of its full size that exploration noise has for differential bases.
_ROLLING_NOISE = 0.85
#: How long such a base holds it, beside the time of its longest turn [s].
_ROLLING_PERIOD = 1.5
#: Moments closer than this are the same moment [s].
_SAME_TIME = 1e-9


@kernel
def _mixed(value):
    """The output function of SplitMix64: a bijection of 64-bit numbers that looks random."""
    value ^= value >> np.uint64(30)
    value *= np.uint64(0xBF58476D1CE4E5B9)
    value ^= value >> np.uint64(27)
    value *= np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@kernel
def _fill(keys, slot, out):
    golden = np.uint64(0x9E3779B97F4A7C15)
    for b in range(out.shape[0]):
        for i in range(out.shape[1]):
            state = _mixed(keys[b] + golden * np.uint64(i + 1))
            state = _mixed(state + golden * np.uint64(slot + 1))
            first = _mixed(state + golden)
            second = _mixed(state + golden + golden)
            # Box-Muller, on numbers in (0, 1] and [0, 1) with 53 random bits.
            radius = np.sqrt(-2.0 * np.log(((first >> np.uint64(11)) + 1.0) / 2.0**53))
            angle = 2.0 * np.pi * ((second >> np.uint64(11)) / 2.0**53)
            out[b, i, 0] = radius * np.cos(angle)
            out[b, i, 1] = radius * np.sin(angle)


def noise_scale(drive: Drive) -> float:
    """Share of its full size that exploration noise has for robots with this base.

    That of a slow base is smaller, because what is cut to one speed, noise and command alike, would be hardly anything
    but noise. It lasts longer instead: held in inverse proportion to the speed, a size that falls as its square root
    still carries robots far enough to break strained patches. A differential base spends most of the time that a noise
    lasts on turning to it, so there it has one size at all speeds.
    """
    return _ROLLING_NOISE if drive.is_differential else math.sqrt(_speed_share(drive))


def noise_period(drive: Drive, pace: float = 1.0) -> float:
    """How long a robot holds its noise [s]: ``NOISE_PERIOD``, longer for slow bases and for those that must turn to it.

    Args:
        drive: Its base.
        pace: Share of full speed at which it drives, see ``triform.simulation.pace``: what is driven at a share of the
            speed for longer in proportion leads equally far.
    """
    wheels = drive.wheels
    if wheels is None:
        return NOISE_PERIOD / (_speed_share(drive) * pace)
    return (_ROLLING_PERIOD + (0.5 if wheels.reverses else 1.0) * math.pi / wheels.max_turn_rate) / pace


def _speed_share(drive: Drive) -> float:
    """Speed of a holonomic base along each axis as a share of that at which noise has its full size, at most 1."""
    return min(1.0, min(drive.max_speed, drive.max_axis_speed) / _FULL_NOISE_SPEED)


def noise_keys(seeds: Sequence[np.random.SeedSequence], worlds: int) -> NDArray[np.uint64]:
    """One key for every world: of its seed, or its index where there are no seeds; shape (B,)."""
    chosen = seeds if len(seeds) else [np.random.SeedSequence(world) for world in range(worlds)]
    return np.array([seed.generate_state(1, np.uint64)[0] for seed in chosen], dtype=np.uint64)


def exploration_noise(keys: NDArray[np.uint64], robots: int, time: float, period: float = NOISE_PERIOD) -> FloatArray:
    """Standard normal numbers of all robots at a time.

    Args:
        keys: Of every world, from ``noise_keys``, shape (B,).
        robots: Robots of each world, N.
        time: Time since the start [s].
        period: How long the numbers stay the same [s].

    Returns:
        Shape (B, N, 2).
    """
    out = np.empty((len(keys), robots, 2))
    _fill(keys, int((time + _SAME_TIME) / period), out)
    return out


def noise_in_body(
    keys: NDArray[np.uint64], drive: Drive, time: float, headings: FloatArray, first: int = 0, pace: float = 1.0
) -> FloatArray:
    """Exploration noise as a view offers it: in the robots' own frames, of the size that their base is fit for.

    A differential robot turns to where its noise points, so there the noise keeps its direction while it lasts.

    Args:
        keys: Of every world, from ``noise_keys``, shape (B,).
        drive: Base of the robots.
        time: Time since the start [s].
        headings: By odometry, from any beginning [rad], shape (B, N).
        first: Index of the first of these robots in its team.
        pace: Of these robots, see ``noise_period``.

    Returns:
        Shape (B, N, 2).
    """
    team = exploration_noise(keys, first + headings.shape[1], time, noise_period(drive, pace))
    noise = noise_scale(drive) * team[:, first:]
    if not drive.is_differential:
        return noise
    cos, sin = np.cos(headings), np.sin(headings)
    return np.stack([cos * noise[..., 0] + sin * noise[..., 1], cos * noise[..., 1] - sin * noise[..., 0]], axis=-1)
