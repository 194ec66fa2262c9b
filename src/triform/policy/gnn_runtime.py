"""Running a graph network with ONNX Runtime, without PyTorch."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from triform.policy.config import GnnConfig
from triform.policy.radius_graph import EDGE_FEATURES, RadiusGraph
from triform.policy.runtime import StoredPolicy
from triform.types import ConfigurationError, FloatArray, require


class GnnRuntime(StoredPolicy):
    """A graph network that drives teams whose robots talk; may be called from several threads at once."""

    def __init__(self, folder: Path, threads: int = 1) -> None:
        """Load the policy in ``folder``.

        Args:
            folder: Holds an exported policy.
            threads: Threads of one call.

        Raises:
            TriformError: If the folder holds no exported policy, it cannot be loaded, or it is no graph network.
        """
        super().__init__(folder, threads)
        self._load(self.network.outputs, "features", EDGE_FEATURES)

    @property
    def network(self) -> GnnConfig:
        """Shape of the network.

        Raises:
            ConfigurationError: If it is of another kind.
        """
        if not isinstance(self.spec.network, GnnConfig):
            raise ConfigurationError(f"the policy in {self.folder} reads occupancy maps; a graph network is needed")
        return self.spec.network

    def commands(self, teams: RadiusGraph) -> FloatArray:
        """What all M robots of some teams are to do, shape (M, outputs), in units of d*.

        What a robot gets is the same to the bit whatever other teams are in the call.

        Raises:
            ConfigurationError: If an edge ends at no robot, or edges have another number of features.
        """
        robots, edges = teams.robots, len(teams.receivers)
        ends = np.concatenate([teams.receivers, teams.senders])
        require(
            teams.features.shape == (edges, EDGE_FEATURES) and len(ends) == 2 * edges
            and bool(((ends >= 0) & (ends < robots)).all()),
            f"edges with features of shape {teams.features.shape} between {robots} robots given; (E, {EDGE_FEATURES}) "
            "is needed, and each end must be a robot",
        )  # fmt: skip
        # Two more robots hear each other: a matrix of a single row is multiplied in another order than one of several.
        features = np.zeros((edges + 2, EDGE_FEATURES), dtype=np.float32)
        features[:edges] = teams.features
        given = {
            "features": features,
            "receivers": np.append(teams.receivers, [robots, robots + 1]),
            "senders": np.append(teams.senders, [robots + 1, robots]),
            "robots": np.array([robots + 2], dtype=np.int64),
        }
        (out,) = self._session.run(["commands"], given)
        answers: FloatArray = out[:robots].astype(np.float64)
        return answers
