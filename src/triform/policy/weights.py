"""Weights of PyTorch networks as safetensors, next to their description."""

from __future__ import annotations

from pathlib import Path

import safetensors.torch
from safetensors import SafetensorError

from triform.policy.checkpoint import SPEC_FILE, WEIGHTS_FILE, PolicySpec, read_spec
from triform.policy.vit import VisionTransformer
from triform.types import TriformError


def save_policy(folder: Path, network: VisionTransformer, spec: PolicySpec) -> None:
    """Write a policy into ``folder``; each file is complete or absent, and an old one stays until then.

    Raises:
        TriformError: If the files cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in (
            (WEIGHTS_FILE, safetensors.torch.save(tensors)),
            (SPEC_FILE, spec.to_json().encode()),
        ):
            write_atomically(folder / name, content)
    except OSError as error:
        raise TriformError(f"cannot write the policy to {folder}: {error}") from error


def write_atomically(path: Path, content: bytes) -> None:
    """Replace ``path`` by ``content``, or leave it as it was."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_policy(folder: Path) -> tuple[VisionTransformer, PolicySpec]:
    """Read a policy with its weights.

    Raises:
        TriformError: If the folder holds no policy, or its weights do not fit its description.
    """
    spec = read_spec(folder)
    path = folder / WEIGHTS_FILE
    network = VisionTransformer(spec.network)
    try:
        network.load_state_dict(safetensors.torch.load_file(path))
    except (OSError, SafetensorError) as error:
        raise TriformError(f"cannot read the weights {path}: {error}") from error
    except RuntimeError as error:
        raise TriformError(f"the weights {path} do not fit the network that {SPEC_FILE} describes") from error
    return network.eval(), spec
