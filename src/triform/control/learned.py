"""Algorithm 2: the learned policy on every robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from triform.control.last_step import LastStep, robot_rows
from triform.control.scan_packer import SCANS_AT_ONCE, ScanPacker
from triform.perception import occupancy_maps
from triform.policy import GnnRuntime, PolicyRuntime, PolicySpec, describe_network, map_network
from triform.threads import in_parts
from triform.types import FloatArray, MapArray, MapConfig, Scan, ScanConfig, View, require

#: Robots whose commands keep a thread busy for a few milliseconds.
_ROBOTS_PER_THREAD = 64

#: By then every robot has had its first scan [s].
_FIRST_SCAN = 1.0


def twist_spec(runtime: PolicyRuntime | GnnRuntime) -> PolicySpec:
    """Return what a policy says of itself.

    Raises:
        ConfigurationError: It does not give body twists.
    """
    outputs = runtime.spec.network.outputs
    require(
        outputs in (3, 4),
        f"the policy in {runtime.folder} gives {outputs} numbers, not a body twist with or without the amplitude of "
        "exploration noise",
    )
    return runtime.spec


def view_maps(view: View, spec: PolicySpec, distance: float) -> tuple[MapArray, MapConfig]:
    """Return the occupancy maps that a policy makes of what robots see, shape (B, N, H, W), and their shape.

    Args:
        view: What they see.
        spec: The policy.
        distance: Prescribed neighbour distance d* [m].

    Raises:
        ConfigurationError: The scans or the distance do not fit the policy's training.
    """
    used, config = spec.views(view.scans.config, distance)
    return occupancy_maps(Scan(view.scans.ranges, used), config, view.odometry), config


def describe_policy(runtime: PolicyRuntime | GnnRuntime, **settings: Any) -> dict[str, Any]:
    """Return weights, settings and network of a policy, plain JSON values."""
    spec = runtime.spec
    weights = {"weights": runtime.folder.name, "weights_sha256": spec.weights_sha256}
    return {**weights, **settings, "network": describe_network(spec.network)}


def to_twists(answers: FloatArray, noise: FloatArray | None, spec: PolicySpec, scale: float) -> FloatArray:
    """Body twists (M, 3) of a network's answers (M, 3 or 4), with exploration noise (M, 2) and rest, scaled to d*."""
    twists = answers[:, :3]
    if answers.shape[1] > 3 and noise is not None:
        amplitude = answers[:, 3:]
        twists[:, :2] += np.where(amplitude > spec.least_push, amplitude, 0.0) * noise
    if spec.rest_speed > 0.0:
        twists[np.hypot(twists[:, 0], twists[:, 1]) < spec.rest_speed] = 0.0
    twists[:, :2] *= scale
    return twists


class LearnedPolicy:
    """Scan -> occupancy map -> network -> body twist, the same for every robot; a ``Controller[View]``.

    A policy that learned the triangulating law gives a mean velocity and the amplitude of exploration noise on top of
    it, which the robot's own generator draws. All lengths scale with the prescribed distance. A robot that sees nobody
    has lost its team, and if the policy so says it searches at random; the network has nothing to say then.
    """

    privileged = False

    def __init__(
        self, runtime: PolicyRuntime, distance: float = 1.0, clock: Callable[[], object] | None = None
    ) -> None:
        """Drive robots with a loaded policy.

        Args:
            runtime: The policy.
            distance: Prescribed neighbour distance d* [m].
            clock: Called when maps are made, or need not be, and the network is next, to tell the time of the two.

        Raises:
            ConfigurationError: If the policy was not trained for the distance, or does not give body twists.
        """
        self._spec = spec = twist_spec(runtime)
        self._scale = spec.scale(distance)
        self._runtime = runtime
        self._network = map_network(spec.network)
        self._distance = distance
        self._clock = clock
        self._packed: tuple[ScanConfig, ScanPacker] | None = None
        self._last = LastStep()

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the packer with its workspaces, which the first scan brings back."""
        return self.__dict__ | {"_packed": None}

    @property
    def description(self) -> dict[str, Any]:
        """Name, weights and network of the policy."""
        return {"name": "policy", **describe_policy(self._runtime, distance=self._distance)}

    def command(self, view: View) -> FloatArray:
        """Body twists (B, N, 3) from the newest scans.

        Raises:
            ConfigurationError: If the scans do not fit the policy's training.
        """
        packer = self._packer_for(view.scans)
        active = view.active.reshape(-1)
        ranges = view.scans.ranges.reshape(-1, view.scans.config.rays)
        odometry = robot_rows(view.odometry, len(ranges), 3)
        outputs = self._network.outputs
        # An answer is what the network says, and whether the robot's map is empty.
        changed, answers = self._last.compare(view.scans, odometry, active, outputs + 1)
        asked = np.flatnonzero(changed)
        if self._clock is not None and len(asked) == 0:
            self._clock()

        def ask(first: int, last: int) -> None:
            for begin in range(first, last, SCANS_AT_ONCE):
                some = asked[begin : min(begin + SCANS_AT_ONCE, last)]
                packed = packer.pack(ranges[some], odometry[some])
                if self._clock is not None:
                    self._clock()
                answers[some, :outputs] = self._runtime.commands(packed)
                answers[some, outputs] = packed.counts == 0

        in_parts(ask, len(asked), len(asked), _ROBOTS_PER_THREAD)
        self._last.keep()
        commands = np.zeros((*view.active.shape, 3))
        robots = np.flatnonzero(active)
        known = answers[robots]
        wanted = known[:, :outputs]
        if self._spec.search_push > 0.0 and view.time >= _FIRST_SCAN:
            wanted[known[:, outputs] > 0.0] = (0.0, 0.0, 0.0, self._spec.search_push)
        noise = None if view.noise is None else view.noise.reshape(-1, 2)[robots]
        commands.reshape(-1, 3)[robots] = to_twists(wanted, noise, self._spec, self._scale)
        return commands

    def _packer_for(self, scans: Scan) -> ScanPacker:
        """The packer for scans of this configuration, made when the first one comes."""
        packed = self._packed
        if packed is None or packed[0] != scans.config:
            used, map_config = self._spec.views(scans.config, self._distance)
            network = self._network
            # Set at once, so that no other thread sees the packer of other scans.
            packed = self._packed = scans.config, ScanPacker(used, map_config, network.patch, network.attention)
        return packed[1]
