"""A team whose robots talk: the graph network on what they tell each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from triform.control.learned import describe_policy, to_twists, twist_spec
from triform.control.loop import true_poses
from triform.control.triangulating import BLOCKING_RADIUS
from triform.policy import GnnRuntime, hear
from triform.threads import in_parts
from triform.types import FloatArray, PrivilegedView, require

#: Robots whose commands keep a thread busy for a few milliseconds.
_ROBOTS_PER_THREAD = 128
#: Robots of one call of the network, about: enough to use the processor, few enough to stay in its cache.
_ROBOTS_AT_ONCE = 256


class GnnController:
    """True poses within reach -> graph network -> body twists; a ``Controller[PrivilegedView]``.

    Robots tell each other where they are and what they have heard themselves, in the network's rounds of messages, so
    each knows more than a robot with a LiDAR does. It is a baseline, not a policy for one robot alone.
    """

    privileged = True

    def __init__(self, runtime: GnnRuntime, distance: float = 1.0, blocking_radius: float = BLOCKING_RADIUS) -> None:
        """Drive teams with a loaded graph network.

        Args:
            runtime: The network.
            distance: Prescribed neighbour distance d* [m].
            blocking_radius: A robot hides who is behind a disc of this radius around it [m]; the network knows it,
                because it decides whom its teacher saw.

        Raises:
            ConfigurationError: If the network was not trained for the distance, or does not give body twists.
        """
        self._scale = twist_spec(runtime).scale(distance)
        require(
            0 <= blocking_radius < np.inf, f"blocking_radius is {blocking_radius} m; it must be finite, not negative"
        )
        self._runtime = runtime
        self._distance = distance
        self._blocking = blocking_radius

    @property
    def description(self) -> dict[str, Any]:
        """Name, weights and network."""
        settings = {"distance": self._distance, "blocking_radius": self._blocking}
        return {"name": "gnn", **describe_policy(self._runtime, **settings)}

    def command(self, view: PrivilegedView) -> FloatArray:
        """Return body twists (B, N, 3) from true poses.

        Raises:
            TriformError: If the view carries no poses, or poses that are not finite.
        """
        all_poses = true_poses(view, "a team that talks")
        commands = np.zeros((*view.active.shape, 3))
        worlds, robots = view.active.shape
        at_once = max(1, _ROBOTS_AT_ONCE // max(robots, 1))

        def drive(first: int, last: int) -> None:
            for begin in range(first, last, at_once):
                some = slice(begin, min(begin + at_once, last))
                commands[some][view.active[some]] = self._twists(view, all_poses[some], some)

        in_parts(drive, worlds, view.active.size, _ROBOTS_PER_THREAD)
        return commands

    def _twists(self, view: PrivilegedView, poses: FloatArray, worlds: slice) -> FloatArray:
        """Body twists of the active robots of some worlds with their poses, world by world, shape (M, 3)."""
        active = view.active[worlds]
        poses = poses[active] / (self._distance, self._distance, 1.0)
        offsets = np.concatenate([[0], np.cumsum(active.sum(axis=1))])
        blocking = np.full(len(active), self._blocking / self._distance)
        answers = self._runtime.commands(hear(poses, offsets, blocking, self._runtime.network.reach))
        noise = None if view.noise is None else view.noise[worlds][active]
        return to_twists(answers, noise, self._runtime.spec, self._scale)
