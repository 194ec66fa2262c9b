"""``triform show``: profiles, arenas, controllers and policies, and how bright recorded returns are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from triform.commands.terminal import Terminal
from triform.control import CONTROLLERS, ControllerSpec, shipped_weights
from triform.control.user import installed_controllers
from triform.policy import describe_network, read_spec
from triform.robots.scan_file import read_scans
from triform.simulation import ARENAS, PROFILES, Profile, arena_toml, get_arena, get_profile, noise_sigma, profile_toml
from triform.timing.step_time import count_parameters, what_it_sees
from triform.types import TriformError, convert_fields, require

What = Literal["profile", "arena", "controllers", "policies", "intensities"]
#: Shares of recorded returns whose intensities are shown; the last is all.
_SHARES = (0.001, 0.01, 0.5, 0.99, 0.999, 1.0)
#: What the shipped policy was trained on: sizes of outlines [m], rays, range noise at 1 m [m].
_TRAINED_SIZES, _TRAINED_RAYS, _TRAINED_NOISE = (0.2, 0.41), 450, 0.03


def beyond_training(robot: Profile) -> list[str]:
    """Return in what a robot differs from those that the shipped policy was trained for, in a few words each."""
    length, width, lidar = robot.footprint.length, robot.footprint.width, robot.lidar
    smallest, largest = _TRAINED_SIZES
    noise = float(noise_sigma(np.ones(1), lidar.noise)[0])
    found = {
        "base": robot.drive.is_differential,
        "size": not (smallest <= min(length, width) and max(length, width) <= largest),
        "rays": lidar.scan.rays < _TRAINED_RAYS,
        "noise": noise > _TRAINED_NOISE,
        "odometry": not robot.odometry,
    }
    return [words for words, differs in found.items() if differs]


@dataclass(frozen=True)
class Show:
    """Options of ``triform show``.

    Attributes:
        what: What to show.
        name: Profile or arena to print as TOML, to start from: a name or a TOML file; a table of all if omitted. For
            intensities, the folder of a recording of triform drive.
    """

    what: Annotated[What, tyro.conf.Positional] = "profile"
    name: Annotated[str | None, tyro.conf.Positional] = None

    def __post_init__(self) -> None:
        convert_fields(self)
        require(
            self.name is None or self.what in ("profile", "arena", "intensities"),
            f"name is {self.name!r}, but {self.what} are only listed",
        )
        require(
            self.name is not None or self.what != "intensities",
            "name is missing; intensities are those of a recording, which triform drive --record FOLDER makes",
        )

    def run(self, console: Console) -> None:
        """Print a file to start from, or a table."""
        terminal = Terminal(console)
        if self.what == "profile" and self.name is not None:
            console.file.write(profile_toml(get_profile(self.name)))
        elif self.what == "arena" and self.name is not None:
            console.file.write(arena_toml(get_arena(self.name)))
        elif self.what == "intensities" and self.name is not None:
            found = read_scans(Path(self.name)).summarise(_SHARES)
            if not found:
                raise TriformError(f"the scans in {self.name} have no returns whose intensity is known")
            rows = [[f"{begin:g}", f"{count:,}", *(f"{each:.0f}" for each in levels)] for begin, count, levels in found]
            headings = ["from [m]", "returns", *(f"{100 * share:g} %" for share in _SHARES)]
            terminal.table("intensities that a share of the returns does not exceed", headings, rows)
        elif self.what == "profile":
            rows = [
                [
                    name,
                    robot.footprint.label,
                    str(robot.lidar.scan.rays),
                    robot.drive.kind,
                    f"{min(robot.drive.max_speed, robot.drive.max_axis_speed):g}",
                    ", ".join(beyond_training(robot)) or "-",
                ]
                for name, robot in PROFILES.items()
            ]
            headings = ["profile", "footprint", "rays", "base", "m/s", "new"]
            note = "m/s: largest speed; new: what the shipped policy was not trained for"
            terminal.table("robot profiles", headings, rows, note)
        elif self.what == "arena":
            rows = [[name, str(len(arena.walls)), str(len(arena.pillars))] for name, arena in ARENAS.items()]
            terminal.table("arenas", ["arena", "walls", "circles"], rows)
        elif self.what == "controllers":
            rows = [[name, what_it_sees(ControllerSpec(name))] for name in CONTROLLERS]
            rows += [[name, point.value] for name, point in installed_controllers().items()]
            terminal.table("controllers", ["controller", "sees"], rows)
        else:
            rows = [
                [name, str(describe_network(read_spec(folder).network)["kind"]), f"{count_parameters(folder):,}"]
                for name, folder in shipped_weights().items()
            ]
            terminal.table("shipped policies", ["policy", "network", "parameters"], rows)
