"""Controllers by name."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from triform.control.expert import EXPERTS, Expert
from triform.control.learned import LearnedPolicy
from triform.control.scan_pipeline import ScanPipeline
from triform.control.triangulating import Triangulating
from triform.policy import PolicyRuntime
from triform.types import ConfigurationError, Controller

CONTROLLERS = ("policy", *EXPERTS, "triangulating", "scan-pipeline")
DEFAULT_WEIGHTS = "default"


def shipped_weights() -> dict[str, Path]:
    """Folders of the policies that come with the package, by name."""
    root = Path(str(resources.files("triform") / "weights"))
    return {folder.name: folder for folder in sorted(root.iterdir()) if folder.is_dir()} if root.is_dir() else {}


def weights_folder(weights: str | None) -> Path:
    """Folder of the policy called ``weights``: a shipped name or a path; the default policy if ``None``.

    Raises:
        ConfigurationError: If there is no such policy.
    """
    shipped = shipped_weights()
    name = weights or DEFAULT_WEIGHTS
    folder = shipped.get(name, Path(name))
    if not folder.exists():
        raise ConfigurationError(f"there is no policy {name!r}: it is neither a folder nor one of {', '.join(shipped)}")
    return folder


def make_controller(name: str, distance: float = 1.0, weights: str | None = None, threads: int = 1) -> Controller[Any]:
    """Make a controller.

    Args:
        name: One of ``CONTROLLERS``.
        distance: Prescribed neighbour distance d* [m].
        weights: For ``policy``: a shipped policy's name or a folder; the default policy if ``None``.
        threads: For ``policy``: threads of one call of the network, see ``PolicyRuntime``.

    Raises:
        ConfigurationError: If there is no such controller, or it cannot be made with these settings.
    """
    if name not in CONTROLLERS:
        raise ConfigurationError(f"there is no controller {name!r}; there are {', '.join(CONTROLLERS)}")
    if weights is not None and name != "policy":
        raise ConfigurationError(f"the controller {name!r} has no weights; they belong to 'policy'")
    if name == "policy":
        return LearnedPolicy(PolicyRuntime(weights_folder(weights), threads), distance)
    if name in EXPERTS:
        return Expert.named(name, distance)
    if name == "triangulating":
        return Triangulating(distance)
    return ScanPipeline(distance)
