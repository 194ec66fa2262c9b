"""All parameters of a module in one vector, and all gradients in another.

The optimiser, the clipping of gradients and their sum over processes then take one operation each instead of one for
each of dozens of small tensors, which would cost more to launch than to compute.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class FlatParameters:
    """Parameters and gradients of a module as two vectors of which the module's own tensors are views.

    Attributes:
        values: All parameters, one behind the other, as the one parameter that the optimiser sees.
        gradient: Their gradients, with one more number at the end, for the loss.
    """

    def __init__(self, module: nn.Module) -> None:
        """Make the parameters of ``module``, which must be on their device already, views of one vector."""
        parameters = list(module.parameters())
        self.values = nn.Parameter(torch.cat([parameter.detach().reshape(-1) for parameter in parameters]))
        self.gradient = self.values.new_zeros(self.values.numel() + 1)
        self.values.grad = self.gradient[:-1]
        at = 0
        for parameter in parameters:
            size = parameter.numel()
            parameter.data = self.values.data[at : at + size].view_as(parameter)
            parameter.grad = self.gradient[at : at + size].view_as(parameter)
            at += size

    def clip(self, largest: float) -> Tensor:
        """Scale the gradient down to a norm of ``largest``, unless that is 0, and return the norm it had."""
        gradient = self.gradient[:-1]
        norm: Tensor = torch.linalg.vector_norm(gradient)
        if largest > 0:
            # The small constant as in torch.nn.utils.clip_grad_norm_.
            gradient.mul_((largest / (norm + 1e-6)).clamp(max=1.0))
        return norm
