"""What happened in runs: poses and commands, recorded while Algorithm 2 drives a team."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from triform.control import control_steps, drive
from triform.evaluation.senses import Senses, SensesLog
from triform.types import BoolArray, Controller, FloatArray, PrivilegedView, Team, as_array, require

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Trajectory:
    """What happened in B runs, recorded once per control period.

    Attributes:
        time: Time of every record since the start of the run [s], shape (T,).
        poses: True poses (x, y, heading) in the world frame [m, m, rad], shape (B, T, N, 3); ``NaN`` where
            a robot does not exist.
        active: Which robots exist, shape (B, T, N).
        commands: Body twists held from each record to the next [m/s, m/s, rad/s], shape (B, T - 1, N, 3).
        senses: What the robots of each kind sensed, in the order of the robots; empty where it is not recorded.
    """

    time: FloatArray
    poses: FloatArray
    active: BoolArray
    commands: FloatArray
    senses: tuple[Senses, ...] = ()

    def __post_init__(self) -> None:
        for name in ("time", "poses", "active", "commands"):
            values, dtype = getattr(self, name), np.bool_ if name == "active" else np.float64
            if type(values) is not np.ndarray or values.dtype != dtype:
                object.__setattr__(self, name, as_array(f"{name} of a trajectory", values, dtype))
        runs, records, robots = self.active.shape if self.active.ndim == 3 else (0, 0, 0)
        require(
            self.time.shape == (records,)
            and self.poses.shape == (runs, records, robots, 3)
            and self.commands.shape == (runs, records - 1, robots, 3)
            and self.active.ndim == 3,
            f"a trajectory has time of shape {self.time.shape}, poses of shape {self.poses.shape}, active of shape "
            f"{self.active.shape} and commands of shape {self.commands.shape}; (T,), (B, T, N, 3), (B, T, N) and "
            "(B, T - 1, N, 3) are needed",
        )

    @property
    def positions(self) -> FloatArray:
        """Positions in the world frame [m], shape (B, T, N, 2)."""
        return self.poses[..., :2]

    @property
    def period(self) -> float:
        """Time between two records [s]."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    def run(self, index: int) -> Trajectory:
        """Return run ``index`` alone, with B = 1."""
        one = slice(index, index + 1)
        senses = tuple(each.part(one, slice(None)) for each in self.senses)
        return Trajectory(self.time, self.poses[one], self.active[one], self.commands[one], senses)

    def since(self, time: float) -> Trajectory:
        """Return the records from ``time`` [s] on."""
        first = int(np.searchsorted(self.time, time - 1e-6))
        senses = tuple(each.part(slice(None), slice(first, None)) for each in self.senses)
        return Trajectory(
            self.time[first:], self.poses[:, first:], self.active[:, first:], self.commands[:, first:], senses
        )

    @classmethod
    def side_by_side(cls, parts: Sequence[Trajectory]) -> Trajectory:
        """Return the runs of several trajectories with the same records and N, one behind the other."""
        poses, active, commands = ([getattr(part, name) for part in parts] for name in ("poses", "active", "commands"))
        kinds = zip(*(part.senses for part in parts), strict=True)
        senses = tuple(first.joined(others, axis=0) for first, *others in kinds)
        return cls(parts[0].time, np.concatenate(poses), np.concatenate(active), np.concatenate(commands), senses)

    def then(self, later: Trajectory) -> Trajectory:
        """Return this trajectory followed by ``later``, whose first record replaces this one's last.

        The two may differ in N: robots that came later are absent from the earlier records.
        """
        robots = max(self.poses.shape[2], later.poses.shape[2])
        return Trajectory(
            np.concatenate([self.time[:-1], later.time]),
            np.concatenate([_widen(self.poses[:, :-1], robots, np.nan), _widen(later.poses, robots, np.nan)], axis=1),
            np.concatenate([_widen(self.active[:, :-1], robots, False), _widen(later.active, robots, False)], axis=1),
            np.concatenate([_widen(self.commands, robots, 0.0), _widen(later.commands, robots, 0.0)], axis=1),
            tuple(
                each.part(slice(None), slice(-1)).joined([other], axis=1)
                for each, other in zip(self.senses, later.senses, strict=True)
            ),
        )


def rollout(
    team: Team[PrivilegedView],
    controller: Controller[PrivilegedView],
    duration: float,
    on_step: Callable[[], None] | None = None,
    scans: bool = False,
) -> Trajectory:
    """Drive ``team`` with ``controller`` for ``duration`` seconds and record the true poses.

    The controller sees what its type says and no more; the poses are recorded for the measures.

    Args:
        team: B worlds of N robots that can tell where its robots really are.
        controller: Any controller, privileged or not.
        duration: Length of the run [s]; a whole number of control periods.
        on_step: Called once per control period, for progress.
        scans: Whether to record what the robots sense, too.

    Returns:
        The trajectory with T = duration / control period + 1 records; the last one follows the last command.

    Raises:
        ConfigurationError: ``duration`` is not a positive whole number of control periods.
    """
    control_steps(duration, team.control_period)
    records: list[tuple[float, FloatArray, BoolArray]] = []
    commands: list[FloatArray] = []
    senses = SensesLog()

    def record(view: PrivilegedView) -> None:
        if scans:
            senses.add(view)
        # Rounded, because a team that adds up its periods is off by more than it should be after hundreds of them.
        records.append((round(view.time, 9), np.array(view.poses), np.array(view.active)))

    def record_step(view: PrivilegedView, command: FloatArray) -> None:
        record(view)
        commands.append(np.array(command))
        if on_step is not None:
            on_step()

    drive(team, controller, duration, record_step)
    record(team.observe())
    time, poses, active = zip(*records, strict=True)
    return Trajectory(
        np.array(time),
        np.stack(poses, axis=1),
        np.stack(active, axis=1),
        np.stack(commands, axis=1),
        senses.senses,
    )


def _widen(array: NDArray[Scalar], robots: int, fill: float) -> NDArray[Scalar]:
    """Append absent robots to the robot axis, the third, until it holds ``robots``."""
    widths = [(0, 0)] * array.ndim
    widths[2] = (0, robots - array.shape[2])
    return np.pad(array, widths, constant_values=fill)
