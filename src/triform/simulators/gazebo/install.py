"""``make gazebo``: makes a Gazebo 11 and the lock-step plugin ready; what is ready already is left alone."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from triform.files import cannot_write, exclusive, make_folder
from triform.simulation.arena import Arena
from triform.simulation.profiles import IDEAL
from triform.simulators.gazebo.installation import Installation, find_gazebo, gazebo_folder, version
from triform.simulators.gazebo.server import GazeboError, GazeboServer
from triform.types import TriformError

#: What is made here, and nothing else in the folder, which may be any folder of the user's.
_OURS = re.compile(r"[0-9a-f]{16}(\.building)?|downloads-[0-9]+")


def install() -> Installation:
    """Make Gazebo ready in ``gazebo_folder()`` and return it.

    It is built under a temporary name, has to simulate something, and only then takes its place.

    Raises:
        TriformError: If that cannot be done; what was there before is then as it was.
    """
    folder = gazebo_folder()
    make_folder(folder)
    with exclusive(folder):
        found = find_gazebo()
        if found is not None:
            return found
        building, place = folder / f"{version()}.building", folder / version()
        _remove(building)
        make_folder(building)
        try:
            with as_file(files("triform.simulators.gazebo")) as here:
                _run_script(here / "install.sh", building)
            _check(Installation.of_folder(building))
            for other in folder.iterdir():
                if _OURS.fullmatch(other.name) and other.is_dir() and other != building:
                    _remove(other)
            building.rename(place)
        finally:
            _remove(building)
        return Installation.of_folder(place)


def _run_script(script: Path, building: Path) -> None:
    """Show the script's progress as it comes; its last words are the reason of a failure."""
    done = subprocess.run(["/bin/bash", script, building], stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        words = done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"]
        raise GazeboError(f"Gazebo could not be made ready: {words[-1]}")


def _check(built: Installation) -> None:
    """Drive one robot for a second."""
    with GazeboServer(IDEAL, Arena.open(), 1, installation=built) as server:
        server.reset(np.zeros((1, 3)))
        reached = server.step([[0.2, 0.0, 0.0]], 100).poses[0, 0]
    if not 0.15 < reached < 0.2:
        raise GazeboError(f"the Gazebo that was made drove {reached:.3f} m instead of almost 0.2 m")


def _remove(folder: Path) -> None:
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise cannot_write(folder, error) from error


def main() -> int:
    """Install, say where, and return the exit status."""
    try:
        found = install()
    except TriformError as error:
        print(f"triform: {error}", file=sys.stderr)
        return 1
    print(f"Gazebo is ready in {found.plugin.parent}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
