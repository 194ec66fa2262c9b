"""Teams of robots that form a triangulation, each seeing only its own 2-D LiDAR."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from triform.version import __version__

if TYPE_CHECKING:
    from triform.control import SafetyFilter, drive, make_controller
    from triform.evaluation.metrics import measure, summarise
    from triform.evaluation.rollout import rollout
    from triform.evaluation.scenario import Scenario
    from triform.experiments.evaluate import evaluate
    from triform.simulation import Arena, Profile, World, make_world
    from triform.types import Controller, PrivilegedView, Scan, ScanConfig, Team, TriformError, View

__all__ = [
    "Arena",
    "Controller",
    "PrivilegedView",
    "Profile",
    "SafetyFilter",
    "Scan",
    "ScanConfig",
    "Scenario",
    "Team",
    "TriformError",
    "View",
    "World",
    "__version__",
    "drive",
    "evaluate",
    "make_controller",
    "make_world",
    "measure",
    "rollout",
    "summarise",
]

#: Module of every public name; each is imported when it is first asked for.
_MODULES = {
    "triform.types": ("Controller", "PrivilegedView", "Scan", "ScanConfig", "Team", "TriformError", "View"),
    "triform.control": ("SafetyFilter", "drive", "make_controller"),
    "triform.simulation": ("Arena", "Profile", "World", "make_world"),
    "triform.evaluation": ("Scenario", "measure", "rollout", "summarise"),
    "triform.experiments.evaluate": ("evaluate",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            value = getattr(importlib.import_module(module), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'triform' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
