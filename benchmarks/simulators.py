"""How much faster than real time MuJoCo and Gazebo simulate robots and their LiDARs, as a table.

python -m benchmarks.simulators

Times are those of the processor, of all threads and processes together, so that other work on the machine counts
little.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

import numpy as np

from triform.evaluation.scenario import GAZEBO_STEPS
from triform.simulation import IDEAL, SimulatedTeam, get_arena, get_profile
from triform.simulators.chassis import BASES, Base
from triform.simulators.gazebo import GazeboServer, GazeboTeam, find_gazebo
from triform.simulators.mujoco import MujocoTeam
from triform.threads import limit_threads
from triform.types import FloatArray

#: Places a team of each world, shape (worlds, robots, 3).
Place = Callable[[FloatArray, Base], AbstractContextManager[SimulatedTeam]]
SIZES = (5, 9, 13)
#: Simulated time of one measurement [s].
DURATION = 5.0
ARENA = get_arena("room-6")
#: The ideal robots, on a differential base with the drive of a TurtleBot 4.
ROLLING = replace(IDEAL, drive=get_profile("turtlebot4").drive)


@contextmanager
def mujoco(poses: FloatArray, base: Base) -> Iterator[SimulatedTeam]:
    """Place a team in MuJoCo."""
    yield MujocoTeam(poses, ROLLING if base == "differential" else IDEAL, ARENA, base=base)


@contextmanager
def gazebo(poses: FloatArray, base: Base) -> Iterator[SimulatedTeam]:
    """Place a team in Gazebo."""
    with GazeboServer(IDEAL, ARENA, poses.shape[1], drive=base, time_step=GAZEBO_STEPS[base]) as server:
        yield GazeboTeam(server, poses)


def processor_time() -> float:
    """Processor time of this process and of its children that have ended [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def speed(place: Place, base: Base, robots: int, worlds: int) -> float:
    """Simulated time of all worlds by processor time."""
    grid = np.array([(0.7 * (i % 4) - 1, 0.7 * (i // 4) - 1, 0.3 * i) for i in range(robots)])
    commands = np.tile([0.05, 0.0, 0.5], (worlds, robots, 1))
    spent = []
    # What starting and stopping take is in both.
    for periods in (1, 1 + round(DURATION / IDEAL.control_period)):
        begun = processor_time()
        with limit_threads(1), place(np.tile(grid, (worlds, 1, 1)), base) as team:
            for _ in range(periods):
                team.apply(commands, IDEAL.control_period)
                team.observe()
        spent.append(processor_time() - begun)
    return worlds * DURATION / (spent[1] - spent[0])


def main() -> None:
    """Print the table."""
    rows: list[tuple[str, Place, int, Collection[Base]]] = [("MuJoCo", mujoco, each, BASES) for each in (1, 10)]
    if find_gazebo() is not None:
        rows.append(("Gazebo 11", gazebo, 1, GAZEBO_STEPS))
    sizes = " | ".join(f"{robots} robots" for robots in SIZES)
    print(f"| | base | teams at once | {sizes} |\n|---|---|---|{'---|' * len(SIZES)}")
    for name, place, worlds, bases in rows:
        for base in bases:
            speed(place, base, 2, worlds)
            speeds = [f"{speed(place, base, robots, worlds):.3g}" for robots in SIZES]
            print(f"| {name} | {base} | {worlds} | {' | '.join(speeds)} |", flush=True)


if __name__ == "__main__":
    main()
