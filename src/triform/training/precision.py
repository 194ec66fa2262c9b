"""Arithmetic of matrix products while training.

``float32`` is what PyTorch does unasked. ``medium`` is its ``set_float32_matmul_precision("medium")``: where the
processor multiplies matrices of bfloat16 or TF32 in hardware (Intel AMX, NVIDIA), products are rounded to that, and
elsewhere another library computes the same float32 products, on some processors at twice the speed. ``bfloat16`` is
PyTorch's autocast: what enters matrix products is rounded to bfloat16, while weights, residuals and losses stay as
they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from triform.training.presets import Precision


@contextmanager
def matrix_products(precision: Precision) -> Iterator[None]:
    """Let float32 matrix products inside be computed as ``precision`` says; it holds for the whole process."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest" if precision == "float32" else "medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def reduced(precision: Precision, device: torch.device) -> torch.autocast:
    """Context in which matrix products round what enters them, if ``precision`` wants that."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16")
