"""What a file of kept runs says besides its rows: settings, d*, arena, footprints, and measures of whole runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from triform.decode import decode_dataclass, decode_json
from triform.evaluation.events import Event
from triform.evaluation.metrics import RunTable
from triform.evaluation.scenario import Scenario
from triform.report.output import plain
from triform.simulation import Arena, Footprint, LidarConfig
from triform.types import ConfigurationError, ScanConfig, TriformError, require
from triform.version import __version__

#: Version of the format.
FORMAT = 1
#: Where poses come from: a simulation knows the true ones at every moment, a robot those of its odometry.
Source = Literal["simulation", "odometry"]
#: Measures that need more than the records of a run: what happened between two of them, or right before its event.
WHOLE_RUN = (
    "min_distance",
    "collision",
    "hit_arena",
    "robots_before",
    "formed_before",
    "strict_before",
    "changed_robot",
)


@dataclass(frozen=True)
class LidarTable:
    """A LiDAR as JSON has it.

    Attributes:
        scan: Rays of a full turn and limits of range, as controllers see them.
        period: Time of one turn [s].
        rolling: Whether each ray is measured at its own moment of the turn; otherwise all at the turn's end.
    """

    scan: ScanConfig
    period: float
    rolling: bool

    @classmethod
    def of(cls, lidar: LidarConfig) -> LidarTable:
        """Return a LiDAR of a profile."""
        return cls(lidar.scan, lidar.period, lidar.rolling)


@dataclass(frozen=True)
class RunSetting:
    """What measures and drawings of a run need besides its trajectory.

    Attributes:
        distance: Prescribed neighbour distance d* [m].
        footprint: Outline of all robots, or of each.
        arena: Walls and pillars.
        event: What happens during the run.
        lidars: LiDAR of each kind of robots, in their order, where scans are recorded.
    """

    distance: float
    footprint: Footprint | tuple[Footprint, ...]
    arena: Arena
    event: Event | None = None
    lidars: tuple[LidarTable, ...] = ()

    @classmethod
    def of(cls, scenario: Scenario, robots: int) -> RunSetting:
        """Return the setting of runs of a scenario with ``robots`` robots, those that join included."""
        lidars = tuple(LidarTable.of(profile.lidar) for profile in scenario.team.profiles)
        return cls(scenario.distance, scenario.team.outlines(robots), scenario.surroundings, scenario.event, lidars)

    def of_robots(self, robots: Sequence[int]) -> RunSetting:
        """Return the setting of a run of some of the robots."""
        outline = self.footprint
        return self if isinstance(outline, Footprint) else replace(self, footprint=tuple(outline[i] for i in robots))


@dataclass(frozen=True)
class ArenaTable:
    """An arena as JSON has it.

    Attributes:
        name: Its name.
        walls: Segments x1, y1, x2, y2 [m].
        pillars: Circles x, y, radius [m].
    """

    name: str
    walls: tuple[tuple[float, float, float, float], ...]
    pillars: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class RunEntry:
    """One run of a file.

    Attributes:
        run: Its number in the file.
        start: Index of its start; ``None`` if it has none.
        robots: Its robots, those that join included.
        distance: Prescribed neighbour distance d* [m].
        arena: Number of its arena among those of the file.
        footprint: Outline of all robots, or of each, as ``--footprint`` takes it.
        event: What happens during the run.
        min_distance: Smallest distance of two centres in the whole run [m]; ``None`` without a pair.
        collision: Whether two footprints ever overlapped; ``None`` if the records alone can say.
        hit_arena: Whether a footprint ever overlapped a wall or pillar; ``None`` as above.
        robots_before: Robots before the event, as the measures after it.
        formed_before: Whether the 5 s before the event were a success.
        strict_before: Whether the team was strict right before the event.
        changed_robot: The robot that joined, left or was pushed.
    """

    run: int
    start: int | None
    robots: int
    distance: float
    arena: int
    footprint: tuple[str, ...]
    event: Event | None
    min_distance: float | None = None
    collision: bool | None = None
    hit_arena: bool | None = None
    robots_before: int | None = None
    formed_before: bool | None = None
    strict_before: bool | None = None
    changed_robot: int | None = None

    @property
    def measures(self) -> RunTable:
        """Measures of the whole run, one row; none if the records alone can say."""
        if self.collision is None:
            return {}
        given = {name: getattr(self, name) for name in WHOLE_RUN}
        closest = np.inf if self.min_distance is None else self.min_distance
        return {name: np.array([value]) for name, value in given.items() if value is not None} | {
            "min_distance": np.array([closest])
        }


@dataclass(frozen=True)
class Description:
    """What the metadata of a file holds.

    Attributes:
        format: Version of the format.
        triform: Version of the package that wrote it.
        source: Where its poses come from.
        settings: Settings and controller, for people.
        arenas: The arenas of its runs.
        runs: The runs, in the order of the rows.
        lidars: The LiDARs whose scans it holds; none where scans are not kept.
    """

    format: int
    triform: str
    source: Source
    settings: dict[str, Any]
    arenas: tuple[ArenaTable, ...]
    runs: tuple[RunEntry, ...]
    lidars: tuple[LidarTable, ...] = ()

    def setting(self, entry: RunEntry) -> RunSetting:
        """Return the setting of a run.

        Raises:
            ConfigurationError: A footprint, a number or the arena is not allowed.
        """
        require(0 < entry.distance < np.inf, f"distance is {entry.distance} m; it must be positive and finite")
        require(0 <= entry.arena < len(self.arenas), f"there is no arena {entry.arena}")
        require(
            len(entry.footprint) in (1, entry.robots),
            f"{len(entry.footprint)} footprints given; one for all {entry.robots} robots or one for each is needed",
        )
        outlines = tuple(map(Footprint.parse, entry.footprint))
        table = self.arenas[entry.arena]
        walls, pillars = np.array(table.walls).reshape(-1, 4), np.array(table.pillars).reshape(-1, 3)
        footprint = outlines[0] if len(outlines) == 1 else outlines
        return RunSetting(entry.distance, footprint, Arena(table.name, walls, pillars), entry.event)

    def encode(self) -> bytes:
        """Return the description as JSON, with LiDARs where scans are kept."""
        values = asdict(self)
        if not self.lidars:
            del values["lidars"]
        return json.dumps(plain(values), allow_nan=False).encode()


def decode_description(data: bytes, source: str) -> Description:
    """Read what ``Description.encode`` wrote.

    Raises:
        TriformError: It holds something else.
    """
    values = decode_json(data, source)
    version = values.get("format") if isinstance(values, dict) else None
    if version != FORMAT:
        raise TriformError(f"{source} holds runs in format {version!r}; this version reads format {FORMAT}")
    try:
        return decode_dataclass(Description, {"lidars": [], **values}, "the description")
    except ConfigurationError as error:
        raise TriformError(f"{source} cannot be read: {error}") from None


class Descriptions:
    """Collects what a file says of its runs while they are written."""

    def __init__(self, source: Source) -> None:
        """Begin with no run."""
        self._source: Source = source
        self._arenas: list[ArenaTable] = []
        self._runs: list[RunEntry] = []
        self._lidars: list[LidarTable] = []
        #: Settings and controller, for people; plain JSON values.
        self.settings: Mapping[str, Any] = {}

    def add(self, setting: RunSetting, robots: int, measures: Mapping[str, Any]) -> RunEntry:
        """Add a run.

        Args:
            setting: Its setting.
            robots: Its robots, those that join included.
            measures: Measures of the whole run, of which those of ``WHOLE_RUN`` are kept; ``run`` is the index of its
                start.
        """
        place = setting.arena
        arena = ArenaTable(
            place.name, tuple(map(tuple, place.walls.tolist())), tuple(map(tuple, place.pillars.tolist()))
        )
        if arena not in self._arenas:
            self._arenas.append(arena)
        outlines = (setting.footprint,) if isinstance(setting.footprint, Footprint) else setting.footprint
        entry = RunEntry(
            len(self._runs),
            int(measures["run"]) if "run" in measures else None,
            robots,
            float(setting.distance),
            self._arenas.index(arena),
            tuple(each.label for each in outlines),
            setting.event,
            **{name: plain(measures[name]) for name in WHOLE_RUN if name in measures},
        )
        self._runs.append(entry)
        return entry

    def add_lidar(self, lidar: LidarTable) -> int:
        """Add a LiDAR whose scans are kept, unless it is there, and return its number."""
        if lidar not in self._lidars:
            self._lidars.append(lidar)
        return self._lidars.index(lidar)

    @property
    def description(self) -> Description:
        """What the file says."""
        return Description(
            FORMAT,
            __version__,
            self._source,
            dict(self.settings),
            tuple(self._arenas),
            tuple(self._runs),
            tuple(self._lidars),
        )
