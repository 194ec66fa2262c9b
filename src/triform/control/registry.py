"""Controllers by name."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from triform.control.detection import ROBOMASTER_EP_SIZE
from triform.control.expert import EXPERTS, Expert
from triform.control.gnn import GnnController
from triform.control.learned import LearnedPolicy
from triform.control.scan_pipeline import ScanPipeline
from triform.control.triangulating import Triangulating, TriangulatingLaw
from triform.control.user import UserController, installed_controllers, load_class
from triform.geometry.footprint import Footprint
from triform.policy import GnnRuntime, PolicyRuntime, read_spec
from triform.types import SENSING_RANGE, SIGHT, ConfigurationError, Controller, choose, convert_fields, nearest, require

CONTROLLERS = ("policy", *EXPERTS, "triangulating", "scan-pipeline", "scan-triangulating", "gnn")
DEFAULT_WEIGHTS = "default"
_OR_YOURS = ", FILE.py:CLASS and MODULE:CLASS"
#: Controllers with weights, and those that each takes if none are named.
WITH_WEIGHTS = {"policy": DEFAULT_WEIGHTS, "gnn": "gnn"}
#: Controllers that fit a footprint to what they see, and the word for none: they then estimate it from each scan.
WITH_FOOTPRINT = ("scan-pipeline", "scan-triangulating")
UNKNOWN = "unknown"


@dataclass(frozen=True)
class ControllerSpec:
    """A controller by name.

    Attributes:
        name: One of ``CONTROLLERS``, a class as ``FILE.py:CLASS`` or ``MODULE:CLASS``, or an entry point of the group
            ``triform.controllers``.
        weights: Weights of ``policy`` or ``gnn``: a shipped policy's name or a folder; the default one if ``None``.
        footprint: Footprint that ``scan-pipeline`` or ``scan-triangulating`` fits, as ``Footprint.parse`` reads it, or
            ``unknown``; that of the robots if ``None``.
    """

    name: str = "policy"
    weights: str | None = None
    footprint: str | None = None

    def __post_init__(self) -> None:
        convert_fields(self)
        name, weights, footprint = self.name, self.weights, self.footprint
        head, colon, rest = name.partition(":")
        beside = "footprint" if head in WITH_FOOTPRINT else "weights"
        require(
            not colon or head not in CONTROLLERS,
            f"the name of a controller is {name!r}; it is {head!r}, with the {beside} {rest!r} beside it",
        )
        file = name.removesuffix(":")
        require(not file.endswith(".py"), f"the controller {file!r} names no class; write {file}:CLASS")
        if name not in CONTROLLERS and not _names_class(name):
            # The sentence names all that there are.
            known = dict.fromkeys((*CONTROLLERS, *installed_controllers()))
            if name not in known:
                choose("controller", head, known, _OR_YOURS)
        require(
            weights is None or name in WITH_WEIGHTS,
            f"the controller {name!r} has no weights; they belong to {' and '.join(WITH_WEIGHTS)}",
        )
        require(
            footprint is None or name in WITH_FOOTPRINT,
            f"the controller {name!r} takes no footprint; {' and '.join(WITH_FOOTPRINT)} do",
        )
        if footprint not in (None, UNKNOWN):
            try:
                Footprint.parse(footprint)
            except ConfigurationError as error:
                raise ConfigurationError(f"{name} takes a footprint or {UNKNOWN!r}, but the {error}") from error

    @classmethod
    def parse(cls, text: str) -> ControllerSpec:
        """Read ``NAME``, ``policy:WEIGHTS``, ``scan-triangulating:FOOTPRINT``, ``FILE.py:CLASS`` or ``MODULE:CLASS``.

        ``gnn`` takes weights too, and ``scan-pipeline`` a footprint.

        Raises:
            ConfigurationError: There is no such controller.
        """
        name, colon, rest = text.partition(":")
        if not colon or name in CONTROLLERS:
            if name in WITH_FOOTPRINT:
                require(not colon or rest != "", f"the controller {text!r} names no footprint after the colon")
                return cls(name, footprint=rest or None)
            require(not colon or rest != "", f"the controller {text!r} names no weights after the colon")
            return cls(name, rest or None)
        return cls(text)

    @property
    def label(self) -> str:
        """The controller as ``parse`` reads it."""
        return ":".join(filter(None, (self.name, self.weights, self.footprint)))

    @property
    def resolved(self) -> ControllerSpec:
        """The controller with its default weights, if it has weights and none are named."""
        return self if self.weights else replace(self, weights=WITH_WEIGHTS.get(self.name))


#: The shipped policy.
POLICY = ControllerSpec()


def shipped_weights() -> dict[str, Path]:
    """Folders of the policies that come with the package, by name."""
    root = Path(str(resources.files("triform") / "weights"))
    return {folder.name: folder for folder in sorted(root.iterdir()) if folder.is_dir()} if root.is_dir() else {}


def weights_folder(weights: str | None, controller: str = "policy") -> Path:
    """Folder of the policy called ``weights``: a shipped name or a path; the controller's default one if ``None``.

    Raises:
        ConfigurationError: If there is no such policy.
    """
    shipped = shipped_weights()
    name = weights or WITH_WEIGHTS[controller]
    folder = shipped.get(name, Path(name))
    if not folder.exists():
        raise ConfigurationError(
            f"there is no policy {name!r}{nearest(name, shipped)}: it is neither a folder nor one of "
            f"{', '.join(shipped)}"
        )
    return folder


def make_controller(
    controller: str | ControllerSpec,
    distance: float = 1.0,
    threads: int = 1,
    footprint: tuple[float, float] | float = ROBOMASTER_EP_SIZE,
    sight: float = SIGHT,
    noise: float = 0.0,
) -> Controller[Any]:
    """Make a controller.

    Args:
        controller: The controller, such as ``policy``, ``policy:paper``, ``triangulating`` or
            ``scan-triangulating:unknown``.
        distance: Prescribed neighbour distance d* [m].
        threads: For policies: threads of one call of the network, see ``PolicyRuntime``.
        footprint: For those that are told it, the outline of the robots: length and width of a box, or the diameter of
            a circle [m]. A footprint that the controller names itself comes first.
        sight: For the triangulating law, how far robots look [d*]; a policy looks as far as in its training.
        noise: For the scan pipelines, the standard deviation of measured ranges [m].

    Raises:
        ConfigurationError: If there is no such controller, or it cannot be made with these settings.
    """
    spec = ControllerSpec.parse(controller) if isinstance(controller, str) else controller
    name, weights = spec.name, spec.weights
    if name not in CONTROLLERS:
        return UserController(_user_class(name), name, {"distance": distance, "footprint": footprint})
    if name == "policy":
        return LearnedPolicy(PolicyRuntime(weights_folder(weights), threads), distance)
    if name == "gnn":
        return GnnController(GnnRuntime(weights_folder(weights, name), threads), distance, _blocking_radius(footprint))
    if name in EXPERTS:
        return Expert.named(name, distance)
    if name == "triangulating":
        return Triangulating(distance, law=TriangulatingLaw(sight=sight))
    law = TriangulatingLaw(sight=sight) if name == "scan-triangulating" else None
    return ScanPipeline(distance, footprint=_fitted(spec, footprint), law=law, noise=noise)


def sight_of(controller: ControllerSpec) -> float:
    """Return how far a controller looks [d*].

    Raises:
        TriformError: It is a policy that there is not.
    """
    if controller.name in WITH_WEIGHTS:
        spec = read_spec(weights_folder(controller.weights, controller.name))
        return spec.scan.range_max / spec.distance
    return SENSING_RANGE if controller.name in (*EXPERTS, "scan-pipeline") else SIGHT


def _fitted(spec: ControllerSpec, footprint: tuple[float, float] | float) -> tuple[float, float] | float | None:
    """Return the footprint that a scan pipeline fits to robots of ``footprint``; ``None`` if it estimates it."""
    if spec.footprint == UNKNOWN:
        return None
    return footprint if spec.footprint is None else Footprint.parse(spec.footprint).size


def _blocking_radius(footprint: tuple[float, float] | float) -> float:
    """Radius of the disc for which a robot of this outline blocks sight [m]: half its mean width."""
    return sum(footprint) / 4 if isinstance(footprint, tuple) else footprint / 2


def _names_class(name: str) -> bool:
    """Tell whether a name says where a class is: ``FILE.py:CLASS``, or ``MODULE:CLASS`` of a module that is there."""
    where, _, own = name.rpartition(":")
    if not own.isidentifier():
        return False
    if where.endswith(".py"):
        return True
    package = where.split(".")[0]
    if not all(part.isidentifier() for part in where.split(".")):
        return False
    return package in sys.modules or importlib.util.find_spec(package) is not None


def _user_class(name: str) -> type[Any]:
    """Load the class of a user's controller: ``FILE.py:CLASS``, ``MODULE:CLASS`` or an entry point."""
    if ":" in name:
        where, _, own = name.rpartition(":")
        return load_class(where, own)
    point = installed_controllers()[name]
    return load_class(point.module, point.attr)
