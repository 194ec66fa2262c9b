"""Everything from which a killed training continues exactly, in one safetensors file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from triform.files import write_atomically
from triform.types import TriformError

_MODULE = "module."
_OPTIMIZER = "optimizer."


def save_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer, progress: dict[str, Any]) -> None:
    """Write weights, optimiser state and ``progress`` (plain JSON values) to ``path``, atomically.

    Raises:
        TriformError: If it cannot be written; what was there stays.
    """
    tensors = {_MODULE + name: tensor.detach().cpu().contiguous() for name, tensor in module.state_dict().items()}
    for index, values in optimizer.state_dict()["state"].items():
        for name, value in values.items():
            tensors[f"{_OPTIMIZER}{index}.{name}"] = torch.as_tensor(value).detach().cpu().contiguous()
    said = json.dumps(progress)
    metadata = {"progress": said, "sha256": _checksum(said, tensors)}
    write_atomically(path, safetensors.torch.save(tensors, metadata))


def load_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Restore weights and optimiser from ``path`` and return the progress that was saved with them.

    Raises:
        TriformError: If the file is damaged or does not fit this network and optimiser.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - it is no mapping
        # States that were saved by earlier versions have no checksum.
        if set(metadata) != {"progress"} and metadata.get("sha256") != _checksum(metadata["progress"], tensors):
            raise ValueError("its checksum differs")
        progress: dict[str, Any] = json.loads(metadata["progress"])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise TriformError(f"cannot resume from {path}: it is damaged or no training state: {error}") from error
    try:
        module.load_state_dict(
            {name.removeprefix(_MODULE): tensor for name, tensor in tensors.items() if name.startswith(_MODULE)}
        )
        states: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith(_OPTIMIZER):
                index, key = name.removeprefix(_OPTIMIZER).split(".", 1)
                states.setdefault(int(index), {})[key] = tensor
        optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
    except (RuntimeError, ValueError, KeyError) as error:
        raise TriformError(f"cannot resume from {path}: it does not fit this network") from error
    return progress


def _checksum(progress: str, tensors: dict[str, Tensor]) -> str:
    """Checksum of all that a state says."""
    digest = hashlib.sha256(progress.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
