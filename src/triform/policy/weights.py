"""Weights of PyTorch networks as safetensors, next to their description."""

from __future__ import annotations

from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError

from triform.policy.checkpoint import SPEC_FILE, PolicySpec, read_weights, write_policy
from triform.policy.kinds import make_network
from triform.policy.network import PolicyNetwork
from triform.types import TriformError


def save_policy(folder: Path, network: PolicyNetwork, spec: PolicySpec) -> None:
    """Write a policy that is not exported into ``folder``; one that was there stays until it is replaced at once.

    Raises:
        TriformError: If the files cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    write_policy(folder, spec, safetensors.torch.save(tensors))


def load_policy(folder: Path) -> tuple[PolicyNetwork, PolicySpec]:
    """Read a policy with its weights.

    Raises:
        TriformError: If the folder holds no policy, or its weights do not fit its description.
    """
    spec, weights = read_weights(folder)
    return network_of(spec, weights), spec


def network_of(spec: PolicySpec, weights: bytes) -> PolicyNetwork:
    """The network that ``spec`` describes, with the ``weights`` of its safetensors file.

    Raises:
        TriformError: If they do not fit.
    """
    # Without memory for numbers, so that no description can ask for more than the weights have.
    with torch.device("meta"):
        network = make_network(spec.network)
    try:
        network.load_state_dict(safetensors.torch.load(weights), assign=True)
    except (SafetensorError, RuntimeError) as error:
        raise TriformError(f"the weights do not fit the network that {SPEC_FILE} describes") from error
    return network.eval()
