"""``triform export``: a trained policy that runs without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from triform.commands.terminal import Terminal

#: Robots in fresh states for which an exported policy is compared with PyTorch, at least.
_CHECKED_ROBOTS = 1000


@dataclass(frozen=True)
class Export:
    """Options of ``triform export``.

    Attributes:
        folder: Folder of a policy; its graph is written into it.
        precision: Numbers of the linear layers. ``int8`` is faster and less exact.
        out: Another folder for the exported policy.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    precision: Literal["float32", "int8"] = "float32"
    out: Path | None = None

    def run(self, console: Console) -> None:
        """Export, check in fresh states and say how well it went."""
        import numpy as np

        from triform.dataset import fresh_inputs
        from triform.policy import read_spec
        from triform.policy.checkpoint import graph_path
        from triform.policy.export import export_policy

        spec, out = read_spec(self.folder), self.out or self.folder
        difference = export_policy(
            self.folder, fresh_inputs(np.random.default_rng(0), _CHECKED_ROBOTS, spec), self.precision, self.out
        )
        Terminal(console).say(
            f"wrote {graph_path(out, read_spec(out))} in {self.precision}; in fresh states of {_CHECKED_ROBOTS} "
            f"robots its commands differ from PyTorch's by {difference.mean:.0e} on average and "
            f"{difference.largest:.0e} at most",
        )
