from __future__ import annotations

import io

import pytest
from rich.console import Console

from triform.commands.terminal import Terminal
from triform.figures.runs import Scene
from triform.simulation import ROBOMASTER_EP, Arena


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=100)


@pytest.fixture
def listener(console):
    return Terminal(console)


@pytest.fixture
def scene():
    return Scene(ROBOMASTER_EP, Arena.open())
