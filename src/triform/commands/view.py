"""``triform view``: a page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from rich.console import Console

from triform.commands.terminal import Terminal
from triform.viewer.view import ViewConfig, run_view


@dataclass(frozen=True)
class View(ViewConfig):
    """Options of ``triform view``."""

    GROUPS: ClassVar[dict[str, tuple[str, ...]]] = {"recorded run": ("which", "rate"), "server": ("address", "port")}

    file: Annotated[Path | None, tyro.conf.Positional] = None

    def run(self, console: Console) -> None:
        """Show the page, or write it."""
        run_view(self, Terminal(console), console.file.flush)
