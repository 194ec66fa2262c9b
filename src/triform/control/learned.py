"""Algorithm 2: the learned policy on every robot."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from triform.perception import occupancy_maps
from triform.policy import PolicyRuntime, pack
from triform.types import ConfigurationError, FloatArray, View


class LearnedPolicy:
    """Scan -> occupancy map -> network -> body twist, the same for every robot; a ``Controller[View]``."""

    privileged = False

    def __init__(self, runtime: PolicyRuntime, distance: float = 1.0) -> None:
        """Drive robots with a loaded policy.

        Args:
            runtime: The policy.
            distance: Prescribed neighbour distance d* [m].

        Raises:
            ConfigurationError: If the policy was trained for another distance.
        """
        if distance != runtime.spec.distance:
            raise ConfigurationError(
                f"the policy in {runtime.folder} was trained for a distance of {runtime.spec.distance} m, "
                f"not {distance} m"
            )
        network = runtime.spec.network
        if network.outputs != 3:
            raise ConfigurationError(
                f"the policy in {runtime.folder} gives {network.outputs} numbers, not a body twist"
            )
        self._runtime = runtime
        self._spec = runtime.spec

    @property
    def description(self) -> dict[str, Any]:
        """Name, weights and network of the policy."""
        return {
            "name": "policy",
            "weights": self._runtime.folder.name,
            "weights_sha256": self._spec.weights_sha256,
            "distance": self._spec.distance,
            "network": asdict(self._spec.network),
        }

    def command(self, view: View) -> FloatArray:
        """Body twists (B, N, 3) from the newest scans.

        Raises:
            ConfigurationError: If the scans do not fit the policy's training.
        """
        self._spec.check_scan(view.scans)
        network = self._spec.network
        commands = np.zeros((*view.active.shape, 3))
        maps = occupancy_maps(view.scans, self._spec.map)[view.active]
        commands[view.active] = self._runtime.commands(pack(maps, network.patch, network.attention))
        return commands
