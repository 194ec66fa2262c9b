"""VMAS: batched worlds of boxes with LiDARs, in PyTorch."""

from __future__ import annotations

import contextlib
import io
import math
from typing import Any

import numpy as np
import torch

from triform.simulation import Footprint
from triform.types import FloatArray, ScanConfig

# gym, which VMAS imports, prints that it is no longer maintained.
with contextlib.redirect_stderr(io.StringIO()):
    from vmas import make_env
    from vmas.simulator.core import Agent, Box, World
    from vmas.simulator.scenario import BaseScenario
    from vmas.simulator.sensors import Lidar


class _Boxes(BaseScenario):  # type: ignore[misc]
    """Boxes with one LiDAR each, and nothing else."""

    def make_world(self, batch_dim: int, device: torch.device, **kwargs: Any) -> World:
        world = World(batch_dim, device)
        footprint, scan = kwargs["footprint"], kwargs["scan"]
        for i in range(kwargs["robots"]):
            first = scan.angle_min
            lidar = Lidar(world, first, first + 2 * math.pi, n_rays=scan.rays, max_range=scan.range_max)
            shape = Box(length=footprint.length, width=footprint.width)
            world.add_agent(Agent(f"robot_{i}", shape=shape, sensors=[lidar]))
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Places are given from outside."""

    def observation(self, agent: Agent) -> Any:
        return agent.state.pos

    def reward(self, agent: Agent) -> torch.Tensor:
        return torch.zeros(agent.state.pos.shape[0])


class VmasLidars:
    """All LiDARs of robots standing at given poses."""

    def __init__(self, poses: FloatArray, footprint: Footprint, scan: ScanConfig) -> None:
        """Place robots at poses (B, N, 3) [m, m, rad], one VMAS world for each of the B."""
        worlds, robots, _ = poses.shape
        scenario = _Boxes()
        env = make_env(scenario, num_envs=worlds, device="cpu", robots=robots, footprint=footprint, scan=scan, seed=0)
        self._agents = env.agents
        for i, agent in enumerate(self._agents):
            agent.set_pos(torch.from_numpy(poses[:, i, :2]).float(), batch_index=None)
            agent.set_rot(torch.from_numpy(poses[:, i, 2:]).float(), batch_index=None)

    @torch.inference_mode()
    def measure(self, threads: int) -> list[torch.Tensor]:
        """Ranges of every robot in all worlds, N tensors of shape (B, R) [m]; a ray without return has the limit."""
        torch.set_num_threads(threads)
        return [agent.sensors[0].measure() for agent in self._agents]

    def ranges(self) -> FloatArray:
        """The same as one array (B, N, R)."""
        return np.asarray(torch.stack(self.measure(threads=1), dim=1).double().numpy())
