"""Weights to begin a training from: those of a policy that there is already, which may see less far."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from triform.policy import NetworkConfig, map_network
from triform.policy.network import PolicyNetwork
from triform.policy.weights import load_policy
from triform.types import ConfigurationError, MapConfig


def begin_from(folder: Path, policy: PolicyNetwork, config: MapConfig) -> None:
    """Give ``policy`` the weights of the one in ``folder``.

    A Vision Transformer may have a larger map than that: every patch then keeps the embedding of its position relative
    to the robot, and patches beyond the old map begin with that of the nearest patch within it.

    Args:
        folder: Holds a policy.
        policy: Gets its weights.
        config: The occupancy map of ``policy``.

    Raises:
        TriformError: The folder holds no policy.
        ConfigurationError: It is of another kind or shape, or its cells are of another size.
    """
    old, spec = load_policy(folder)
    weights = dict(old.state_dict())
    if spec.map.cell != config.cell:
        raise ConfigurationError(f"cells of the policy {folder} are {spec.map.cell:g} d* wide, not {config.cell:g} d*")
    network = policy.config
    if isinstance(network, NetworkConfig) and isinstance(spec.network, NetworkConfig):
        weights["position"] = _spread(weights["position"], map_network(spec.network).columns, network.columns, folder)
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        raise ConfigurationError(f"the policy {folder} has a network of another shape than this training's") from error


def _spread(position: Tensor, old: int, new: int, folder: Path) -> Tensor:
    """Embeddings of the class token and of ``new`` x ``new`` patches from those of ``old`` x ``old``, (1 + P, D)."""
    if new < old or (new - old) % 2:
        raise ConfigurationError(
            f"the policy {folder} has {old} x {old} patches; a training from it has as many, or an even number more "
            f"along each side, not {new} x {new}"
        )
    margin = (new - old) // 2
    near = (torch.arange(new) - margin).clamp(0, old - 1)
    return torch.cat([position[:1], position[1:][(near[:, None] * old + near).flatten()]])
