"""What a controller costs and what it knows: the time of one robot's step, the size of its network, what it sees."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path

import numpy as np

from triform.control import EXPERTS, ControllerSpec, Triangulating, TriangulatingLaw, drive, weights_folder
from triform.control.registry import UNKNOWN, WITH_FOOTPRINT
from triform.decode import decode_json
from triform.evaluation.scenario import Scenario
from triform.policy.checkpoint import read_weights
from triform.simulation import world_seeds
from triform.threads import limit_threads
from triform.types import Controller, FloatArray, PrivilegedView, TriformError

#: Robots of the team whose views are used; they are looked at in so many moments.
TEAM = 7
_MOMENTS = 20
_PERIODS = 5
#: The first moment [s]; before it, scans of a profile with a latency are empty.
_FIRST = 1.0
#: Calls of one controller in a row, so that what it needs is in the cache, and how often its turn comes.
_CALLS = 50
_TURNS = 8


def record_views(scenario: Scenario, seed: int) -> list[PrivilegedView]:
    """Return what a team of seven sees while it forms a triangulation, at moments 5 control periods apart."""
    world = scenario.make_world(scenario.sample_starts(TEAM, 1, seed), world_seeds(TEAM, seed, [0]))
    seen: list[PrivilegedView] = []

    def look(view: PrivilegedView, _: FloatArray) -> None:
        if view.time >= _FIRST:
            seen.append(view)

    first = int(np.ceil(_FIRST / world.control_period))
    drive(world, Triangulating(scenario.distance), (first + _MOMENTS * _PERIODS) * world.control_period, look)
    return seen[::_PERIODS]


def single_views(views: Sequence[PrivilegedView]) -> list[PrivilegedView]:
    """Return what each robot sees by itself, B = N = 1, robot after robot of every view."""
    return [
        replace(
            view,
            scans=replace(
                view.scans,
                ranges=view.scans.ranges[:, i : i + 1],
                intensities=None if view.scans.intensities is None else view.scans.intensities[:, i : i + 1],
            ),
            active=view.active[:, i : i + 1],
            poses=view.poses[:, i : i + 1],
            noise=None if view.noise is None else view.noise[:, i : i + 1],
            odometry=None if view.odometry is None else view.odometry[:, i : i + 1],
        )
        for view in views
        for i in range(view.active.shape[1])
    ]


def step_times(
    controllers: Mapping[str, Controller[PrivilegedView]], views: Sequence[PrivilegedView]
) -> dict[str, float]:
    """Return the median time of one robot's step, from its view to its command, on one thread [s].

    The controllers take turns of fifty calls, so that whatever else happens on the machine happens to all of them; a
    first turn that is not counted warms each up. A controller that sees poses commands the whole team of ``views``,
    because it would find nobody else in the view of a single robot; its time is divided by the number of robots.

    Args:
        controllers: By name.
        views: What a team sees at several moments, B = 1.
    """
    singles = single_views(views)
    taken: dict[str, list[float]] = {name: [] for name in controllers}
    with limit_threads(1):
        for turn in range(1 + _TURNS):
            for name, controller in controllers.items():
                given = views if controller.privileged else singles
                for call in range(_CALLS):
                    view = given[(turn * _CALLS + call) % len(given)]
                    began = time.perf_counter()
                    controller.command(view)
                    spent = time.perf_counter() - began
                    if turn > 0:
                        taken[name].append(spent / view.active.size)
    return {name: float(np.median(seconds)) for name, seconds in taken.items()}


def count_parameters(folder: Path) -> int:
    """Return how many numbers the weights of the policy in ``folder`` hold.

    Raises:
        TriformError: If they cannot be read.
    """
    weights = read_weights(folder)[1]
    try:
        # A safetensors file begins with the length of its header, 8 bytes, little endian, and the header in JSON.
        header = decode_json(weights[8 : 8 + int.from_bytes(weights[:8], "little")], f"the weights in {folder}")
        return sum(prod(tensor["shape"]) for name, tensor in header.items() if name != "__metadata__")
    except (KeyError, TypeError, AttributeError) as error:
        raise TriformError(f"cannot read the weights in {folder}: {error}") from error


def network_size(controller: ControllerSpec) -> int | None:
    """Return the parameters of a controller's network; ``None`` if it has none.

    Raises:
        TriformError: If its weights cannot be read.
    """
    if controller.resolved.weights is None:
        return None
    return count_parameters(weights_folder(controller.weights, controller.name))


def what_it_sees(controller: ControllerSpec) -> str:
    """Return in a few words from what a controller computes a robot's command; empty if it is not known."""
    sight = f"{TriangulatingLaw().sight:g} d*"
    fitted = controller.footprint
    footprints = "estimates footprints" if fitted == UNKNOWN else f"takes all robots for {fitted}"
    seen = {
        "policy": "own scan and odometry",
        "gnn": f"poses within {sight}, hidden robots too, and messages",
        "triangulating": f"poses within {sight} in line of sight",
    }
    for name in WITH_FOOTPRINT:
        seen[name] = "own scan; " + ("knows the footprint" if fitted is None else footprints)
    for name, variant in EXPERTS.items():
        everybody = np.isinf(variant.sensing_range)
        seen[name] = "everybody's pose" if everybody else f"poses within {variant.sensing_range:g} m"
    return seen.get(controller.name, "")
