"""Controllers that tests of filters put before them."""

from __future__ import annotations

import numpy as np

from triform.types import FloatArray, View


class Given:
    """A controller whose commands are given."""

    privileged = False

    def __init__(self, commands) -> None:
        self.commands = np.asarray(commands, dtype=float)

    @property
    def description(self):
        return {"name": "given"}

    def command(self, view: View) -> FloatArray:
        return self.commands
