"""Algorithm 2: the learned policy on every robot."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from triform.control.scan_packer import SCANS_AT_ONCE, ScanPacker
from triform.policy import PolicyRuntime
from triform.threads import in_parts
from triform.types import ConfigurationError, FloatArray, Scan, View

#: Robots whose commands keep a thread busy for a few milliseconds.
_ROBOTS_PER_THREAD = 64


import os

THR = float(os.environ.get("THR", "0.05"))
DEAD = float(os.environ.get("DEAD", "0.02"))


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
        if network.outputs not in (3, 4):
            raise ConfigurationError(
                f"the policy in {runtime.folder} gives {network.outputs} numbers, not a body twist with or without the "
                "amplitude of a push"
            )
        self._runtime = runtime
        self._spec = runtime.spec
        self._packer: ScanPacker | None = None

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
        packer = self._packer_for(view.scans)
        commands = np.zeros((*view.active.shape, 3))
        robots = np.flatnonzero(view.active)
        ranges = view.scans.ranges.reshape(-1, view.scans.config.rays)
        flat = commands.reshape(-1, 3)
        moved = None if view.moved is None else view.moved.reshape(-1, 3)
        push = None if view.push is None else view.push.reshape(-1, 2)

        def drive(first: int, last: int) -> None:
            for begin in range(first, last, SCANS_AT_ONCE):
                some = robots[begin : min(begin + SCANS_AT_ONCE, last)]
                answers = self._runtime.commands(packer.pack(ranges[some], None if moved is None else moved[some]))
                flat[some] = answers[:, :3]
                if answers.shape[1] > 3 and push is not None:
                    amplitude = answers[:, 3:]
                    flat[some, :2] += np.where(amplitude > THR, amplitude, 0.0) * push[some]
                speed = np.linalg.norm(flat[some, :2], axis=1)
                flat[some] *= (speed > DEAD)[:, None]

        in_parts(drive, len(robots), len(robots), _ROBOTS_PER_THREAD)
        return commands

    def _packer_for(self, scans: Scan) -> ScanPacker:
        """The packer for scans of this configuration, made when the first one comes."""
        packer = self._packer
        if packer is None or packer.scan != scans.config:
            self._spec.check_scan(scans)
            network = self._spec.network
            packer = self._packer = ScanPacker(scans.config, self._spec.map, network.patch, network.attention)
        return packer
