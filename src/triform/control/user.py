"""Controllers of a user's own: a class in a file, in a module, or behind an entry point."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import json
import re
import sys
import threading
from importlib.abc import SourceLoader
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from triform.files import refuse_device
from triform.types import ConfigurationError, FloatArray, PrivilegedView, TriformError, View, nearest

#: Group of entry points of packages that bring controllers.
GROUP = "triform.controllers"

#: Held while a file becomes a module, so that no other thread sees half of it.
_importing = threading.RLock()


class _UserFile(SourceLoader):
    """Source of a user's file, as it was when it was read."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path = path
        self.source = source

    @property
    def module_name(self) -> str:
        """Name of the module, the same in every process; a file that has changed is another module."""
        digest = hashlib.sha256(self.path.encode() + b"\0" + self.source).hexdigest()
        return f"triform_user_{re.sub(r'[^0-9A-Za-z_]', '_', Path(self.path).stem)}_{digest[:16]}"

    def get_filename(self, fullname: str) -> str:  # noqa: ARG002
        """Return the path of the file."""
        return self.path

    def get_data(self, path: str) -> bytes:  # noqa: ARG002
        """Return the source."""
        return self.source

    def module(self) -> ModuleType:
        """Return the module, imported once."""
        name = self.module_name
        with _importing:
            if name in sys.modules:
                return sys.modules[name]
            spec = importlib.util.spec_from_loader(name, self)
            if spec is None:
                raise ConfigurationError(f"{self.path} is no Python file")
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            try:
                self.exec_module(module)
            except BaseException:
                del sys.modules[name]
                raise
            return module


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
        module = _read_file(Path(where)).module() if where.endswith(".py") else importlib.import_module(where)
    except ConfigurationError:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigurationError(f"{where} cannot be imported: {_reason(error)}") from error
    found = getattr(module, name, None)
    if not isinstance(found, type):
        classes = [each for each, value in vars(module).items() if isinstance(value, type) and each[0] != "_"]
        raise ConfigurationError(
            f"{where} has no class {name!r}{nearest(name, classes)}; its classes are {', '.join(classes) or 'none'}"
        )
    return found


def _read_file(path: Path) -> _UserFile:
    try:
        refuse_device(path)
        return _UserFile(str(path.resolve()), path.read_bytes())
    except OSError as error:
        raise ConfigurationError(
            f"the file {path} with a controller cannot be read: {(error.strerror or str(error)).lower()}"
        ) from None


class UserController:
    """A user's controller, whose commands are checked: a ``Controller`` for the views that it asks for.

    The class needs ``command(view)``, which returns body twists of shape (B, N, 3) [m/s, m/s, rad/s]. ``privileged =
    True`` asks for true poses; without it they are kept from the controller in every team. ``description`` may add
    settings to the results. The constructor gets ``distance``, the prescribed neighbour distance d* [m], and
    ``footprint``, if it takes arguments of these names.

    A controller from a file is pickled with the source of the file, which need not be there where it arrives.
    """

    def __init__(self, kind: type[Any], label: str, given: dict[str, Any]) -> None:
        """Make the user's controller.

        Args:
            kind: The user's class.
            label: Name of the controller in results and messages.
            given: Arguments that the constructor may take.

        Raises:
            ConfigurationError: The class has no method ``command``, cannot be made, or says of itself what is no JSON.
        """
        self._label = label
        if not callable(getattr(kind, "command", None)):
            raise ConfigurationError(f"the controller {label!r} has no method command(view)")
        try:
            takes = inspect.signature(kind).parameters
            every = any(each.kind is inspect.Parameter.VAR_KEYWORD for each in takes.values())
            self._own = kind(**{name: value for name, value in given.items() if every or name in takes})
        except (Exception, SystemExit) as error:
            raise ConfigurationError(f"the controller {label!r} cannot be made: {_reason(error)}") from error
        try:
            json.dumps(self.description)
        except Exception as error:
            raise ConfigurationError(
                f"the description of the controller {label!r} is no dict of plain JSON values: {_reason(error)}"
            ) from error

    def __reduce__(self) -> tuple[Any, ...]:
        # The state is read after the module of its class is there.
        loader = getattr(sys.modules.get(type(self._own).__module__), "__loader__", None)
        return _arrive, (type(self), loader if isinstance(loader, _UserFile) else None), self.__dict__

    @property
    def privileged(self) -> bool:
        """Whether the user's controller asks for true poses."""
        return bool(getattr(self._own, "privileged", False))

    @property
    def description(self) -> dict[str, Any]:
        """Name, and what the user's controller says of itself."""
        return {"name": self._label} | dict(getattr(self._own, "description", {}))

    def command(self, view: View) -> FloatArray:
        """Return body twists, shape (B, N, 3); zero for robots that are not active.

        Raises:
            TriformError: The user's controller fails, or returns something else.
        """
        if isinstance(view, PrivilegedView):
            seen = view if self.privileged else _without_poses(view)
        elif self.privileged:
            raise TriformError(f"the controller {self._label!r} needs true poses, and this team cannot offer them")
        else:
            seen = view
        try:
            given = np.asarray(self._own.command(seen))
        except TriformError:
            raise
        except Exception as error:
            raise TriformError(f"the controller {self._label!r} failed: {_reason(error)}") from error
        wanted = (*view.active.shape, 3)
        if given.shape != wanted or given.dtype.kind not in "iuf":
            raise TriformError(
                f"the controller {self._label!r} returned an array of {given.dtype} of shape {given.shape}; body "
                f"twists, numbers of shape {wanted}, are needed"
            )
        commands = np.array(given, dtype=np.float64)
        commands[~view.active] = 0.0
        bad = np.argwhere(~np.isfinite(commands).all(axis=-1))
        if len(bad):
            world, robot = bad[0]
            raise TriformError(
                f"the controller {self._label!r} returned {commands[world, robot].tolist()} for robot {robot} of world "
                f"{world}; a body twist is finite"
            )
        return commands


def _without_poses(view: View) -> View:
    return View(view.scans, view.active, view.time, noise=view.noise, odometry=view.odometry)


def _arrive(kind: type[UserController], file: _UserFile | None) -> UserController:
    """Make room for a controller that was pickled, in a process that may not know its file."""
    if file is not None:
        file.module()
    return kind.__new__(kind)


def _reason(error: BaseException) -> str:
    """Return an exception in one line."""
    line = str(error).strip().splitlines()
    return f"{type(error).__name__}: {line[0]}" if line else type(error).__name__
