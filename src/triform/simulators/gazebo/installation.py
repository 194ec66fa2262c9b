"""Where Gazebo 11 and the plugin built for it are."""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path


@dataclass(frozen=True)
class Installation:
    """A Gazebo 11 that is ready to run.

    Attributes:
        plugin: The lock-step plugin built for it.
        root: Root folder that holds Gazebo and all its libraries; ``None`` for one that is installed on this machine.
    """

    plugin: Path
    root: Path | None

    @classmethod
    def of_folder(cls, folder: Path) -> Installation:
        """Return what ``make gazebo`` puts into a folder."""
        root = folder / "root"
        return cls(folder / "liblockstep.so", root if root.is_dir() else None)


def gazebo_folder() -> Path:
    """Return where ``make gazebo`` puts things: ``$TRIFORM_GAZEBO``, else a folder in the user's cache."""
    chosen = os.environ.get("TRIFORM_GAZEBO")
    if chosen:
        return Path(chosen).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "triform" / "gazebo"


def version() -> str:
    """Return a name for what ``make gazebo`` makes: a hash over all that it is made from."""
    here = files("triform.simulators.gazebo")
    inputs = [here.joinpath(name).read_bytes() for name in ("install.sh", "plugin/lockstep.cc")]
    return hashlib.sha256(b"".join(inputs)).hexdigest()[:16]


def find_gazebo() -> Installation | None:
    """Return the Gazebo that ``make gazebo`` made ready for this version of triform; ``None`` if there is none."""
    found = Installation.of_folder(gazebo_folder() / version())
    runs = found.root is not None or shutil.which("gzserver") is not None
    return found if runs and found.plugin.is_file() else None
