"""Weights of PyTorch networks as safetensors, next to their description."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import safetensors.torch
from safetensors import SafetensorError

from triform.files import make_folder, sha256, write_together
from triform.policy.checkpoint import SPEC_FILE, WEIGHTS_FILE, PolicySpec, read_spec, read_weights
from triform.policy.kinds import make_network
from triform.policy.network import PolicyNetwork
from triform.types import TriformError


def save_policy(folder: Path, network: PolicyNetwork, spec: PolicySpec) -> None:
    """Write a policy into ``folder``; each file is complete or absent, and an old one stays until then.

    Raises:
        TriformError: If the files cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    data = safetensors.torch.save(tensors)
    make_folder(folder)
    described = replace(spec, weights_sha256=sha256(data)).to_json().encode()
    write_together(folder, {WEIGHTS_FILE: data, SPEC_FILE: described})


def load_policy(folder: Path) -> tuple[PolicyNetwork, PolicySpec]:
    """Read a policy with its weights.

    Raises:
        TriformError: If the folder holds no policy, or its weights do not fit its description.
    """
    spec = read_spec(folder)
    data = read_weights(folder, spec)
    network = make_network(spec.network)
    try:
        network.load_state_dict(safetensors.torch.load(data))
    except (SafetensorError, RuntimeError) as error:
        raise TriformError(f"the weights in {folder} do not fit the network that {SPEC_FILE} describes") from error
    return network.eval(), spec
