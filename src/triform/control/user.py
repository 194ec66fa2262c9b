"""Controllers of a user's own: a class in a file, in a module, or behind an entry point."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from triform.types import ConfigurationError, FloatArray, PrivilegedView, TriformError, View

#: Group of entry points of packages that bring controllers.
GROUP = "triform.controllers"


def installed_controllers() -> dict[str, EntryPoint]:
    """Return the entry points of installed controllers, by name."""
    return {point.name: point for point in entry_points(group=GROUP)}


def load_class(where: str, name: str) -> type[Any]:
    """Load a class from a file or a module.

    Args:
        where: Path of a file that ends in ``.py``, or the dotted name of a module.
        name: Name of the class.

    Raises:
        ConfigurationError: There is no such file, module or class, or importing it fails.
    """
    try:
        module = _load_file(Path(where)) if where.endswith(".py") else importlib.import_module(where)
    except ConfigurationError:
        raise
    except Exception as error:
        raise ConfigurationError(f"{where} cannot be imported: {_reason(error)}") from error
    found = getattr(module, name, None)
    if not isinstance(found, type):
        classes = [each for each, value in vars(module).items() if isinstance(value, type) and each[0] != "_"]
        raise ConfigurationError(f"{where} has no class {name!r}; its classes are {', '.join(classes) or 'none'}")
    return found


def _load_file(path: Path) -> ModuleType:
    """Import a file as a module of its own; the same file is imported once."""
    if not path.is_file():
        raise ConfigurationError(f"there is no file {path} with a controller")
    name = f"triform_user_{path.stem}_{abs(hash(path.resolve()))}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


class UserController:
    """A user's controller, whose commands are checked: a ``Controller`` for the views that it asks for.

    The class needs ``command(view)``, which returns body twists of shape (B, N, 3) [m/s, m/s, rad/s]. ``privileged =
    True`` asks for true poses, and ``description`` may add settings to the results. Its constructor gets ``distance``,
    the prescribed neighbour distance d* [m], and ``footprint``, if it takes arguments of these names.
    """

    def __init__(self, kind: type[Any], label: str, given: dict[str, Any]) -> None:
        """Make the user's controller.

        Args:
            kind: The user's class.
            label: Name of the controller in results and messages.
            given: Arguments that the constructor may take.

        Raises:
            ConfigurationError: The class has no method ``command``, or cannot be made.
        """
        self._label = label
        if not callable(getattr(kind, "command", None)):
            raise ConfigurationError(f"the controller {label!r} has no method command(view)")
        try:
            takes = inspect.signature(kind).parameters
            every = any(each.kind is inspect.Parameter.VAR_KEYWORD for each in takes.values())
            self._own = kind(**{name: value for name, value in given.items() if every or name in takes})
        except Exception as error:
            raise ConfigurationError(f"the controller {label!r} cannot be made: {_reason(error)}") from error

    @property
    def privileged(self) -> bool:
        """Whether the user's controller asks for true poses."""
        return bool(getattr(self._own, "privileged", False))

    @property
    def description(self) -> dict[str, Any]:
        """Name, and what the user's controller says of itself."""
        said = getattr(self._own, "description", {})
        return {"name": self._label} | (dict(said) if isinstance(said, dict) else {})

    def command(self, view: View) -> FloatArray:
        """Return body twists, shape (B, N, 3); zero for robots that are not active.

        Raises:
            TriformError: The user's controller fails, or returns something else.
        """
        if self.privileged and not isinstance(view, PrivilegedView):
            raise TriformError(f"the controller {self._label!r} needs true poses, and this team cannot offer them")
        try:
            given = self._own.command(view)
            commands = np.array(given, dtype=np.float64)
        except TriformError:
            raise
        except Exception as error:
            raise TriformError(f"the controller {self._label!r} failed: {_reason(error)}") from error
        wanted = (*view.active.shape, 3)
        if commands.shape != wanted:
            raise TriformError(
                f"the controller {self._label!r} returned body twists of shape {commands.shape}; {wanted} is needed"
            )
        commands[~view.active] = 0.0
        if not np.isfinite(commands).all():
            raise TriformError(f"the controller {self._label!r} returned a body twist that is not finite")
        return commands


def _reason(error: Exception) -> str:
    """Return an exception in one line."""
    line = str(error).strip().splitlines()
    return f"{type(error).__name__}: {line[0]}" if line else type(error).__name__
