"""Where the tensors of a safetensors file lie: a header, and plain numbers behind it."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray


def tensor_table(weights: bytes) -> tuple[dict[str, Any], int]:
    """Return the header of a safetensors file, by name of tensor, and where the numbers begin [bytes]."""
    (length,) = struct.unpack_from("<Q", weights)
    return json.loads(weights[8 : 8 + length]), 8 + length


def read_tensors(weights: bytes) -> dict[str, NDArray[np.float32]]:
    """Return the float32 tensors of a safetensors file by name."""
    header, start = tensor_table(weights)
    tensors = {}
    for name, entry in header.items():
        if entry.get("dtype") == "F32":
            first, last = entry["data_offsets"]
            tensors[name] = np.frombuffer(weights[start + first : start + last], "<f4").reshape(entry["shape"])
    return tensors
