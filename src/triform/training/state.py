"""Everything from which a killed training continues exactly, in one safetensors file."""

from __future__ import annotations

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
    write_atomically(path, safetensors.torch.save(tensors, {"progress": json.dumps(progress)}))


def read_progress(path: Path) -> dict[str, Any]:
    """Read the progress record of a training state.

    Raises:
        TriformError: If the file is missing or is no training state.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        progress: dict[str, Any] = json.loads(metadata["progress"])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise TriformError(f"{path} is not a readable training state: {error}") from error
    return progress


def load_state(path: Path, module: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Restore weights and optimiser from ``path``.

    Raises:
        TriformError: If the file does not fit this network and optimiser.
    """
    try:
        tensors = safetensors.torch.load_file(path)
        module.load_state_dict(
            {name.removeprefix(_MODULE): tensor for name, tensor in tensors.items() if name.startswith(_MODULE)}
        )
        states: dict[int, dict[str, Tensor]] = {}
        for name, tensor in tensors.items():
            if name.startswith(_OPTIMIZER):
                index, key = name.removeprefix(_OPTIMIZER).split(".", 1)
                states.setdefault(int(index), {})[key] = tensor
        optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
    except (OSError, SafetensorError) as error:
        raise TriformError(f"cannot resume from {path}: it is damaged or no training state: {error}") from error
    except (RuntimeError, ValueError, KeyError) as error:
        raise TriformError(f"cannot resume from {path}: it does not fit this network") from error
