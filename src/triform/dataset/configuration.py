"""What is collected: everything that decides the bytes of a data set, and the presets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from triform.control import expert_variant
from triform.decode import decode_dataclass
from triform.simulation import ROBOMASTER_EP, Footprint
from triform.types import IntArray, MapConfig, ScanConfig, convert_fields, require

#: Larger maps, scans and teams are mistakes, and would fill the memory before they are found out.
_MOST_CELLS, _MOST_RAYS, _MOST_ROBOTS = 4096, 100_000, 10_000
#: First words of the seeds of independent random streams.
_ROLL_OUT_STARTS, _PLACEMENTS, _SPLIT, _JITTER = range(4)


@dataclass(frozen=True)
class CollectionConfig:
    """Everything that decides the bytes of a data set.

    The records come in *runs*. Runs ``0 .. runs - 1`` are roll-outs: the teacher drives the team from a random
    start for ``steps`` records. The later runs are blocks of up to ``block_placements`` random placements, drawn
    independently like starts, which the teacher only labels. Both are split into training and validation by
    run, so no validation record has a near twin in training.

    Attributes:
        robots: Robots in every record, N.
        distance: Prescribed neighbour distance d* [m].
        runs: Roll-outs.
        steps: Records of one roll-out.
        placements: Random placements.
        seed: Decides every random number. Starts are drawn from a stream of their own, so they are never those
            of an evaluation with the same seed.
        teacher: Who drives and labels, a name in ``triform.control.EXPERTS``.
        gain: The teacher's spring gain [1/s].
        max_speed: The teacher scales longer commands to this speed [m/s]. Commands are recorded like this.
        speed_limit: The robots follow commands up to this speed [m/s], keeping their direction.
        step_period: Time from one record of a roll-out to the next, for which a command is held [s].
        jitter: Standard deviations [m] of normal offsets added to the recorded (not the driven) positions of
            roll-outs, used in turn from record to record; the teacher labels what is recorded.
        footprint: Outline of the robots that the scans see.
        scan: The noiseless, instantaneous scan of every robot.
        map: The occupancy map made of it.
        validation_share: Share of the runs held out for validation.
        block_placements: Placements in one block.
        shard_runs: Runs in one shard file.
        group_records: Records in one Parquet row group, the unit that is read.
    """

    robots: int = 7
    distance: float = 1.0
    runs: int = 600
    steps: int = 1000
    placements: int = 400_000
    seed: int = 1
    teacher: str = "expert"
    gain: float = 1.0
    max_speed: float = 1.0
    speed_limit: float = 0.5
    step_period: float = 0.01
    jitter: tuple[float, ...] = (0.0,)
    footprint: Footprint = ROBOMASTER_EP
    scan: ScanConfig = field(default_factory=ScanConfig)
    map: MapConfig = field(default_factory=MapConfig)
    validation_share: float = 0.05
    block_placements: int = 1000
    shard_runs: int = 10
    group_records: int = 250

    def __post_init__(self) -> None:
        convert_fields(self)
        least = dict.fromkeys(("robots", "steps", "block_placements", "shard_runs", "group_records"), 1)
        least |= dict.fromkeys(("runs", "placements", "seed"), 0)
        for name, minimum in least.items():
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= minimum,
                f"{name} is {value}; a whole number of at least {minimum} is needed",
            )
        require(
            self.map.size <= _MOST_CELLS and self.scan.rays <= _MOST_RAYS and self.robots <= _MOST_ROBOTS,
            f"maps of {self.map.size} cells along each side, scans of {self.scan.rays} rays and teams of {self.robots} "
            f"robots are asked for; at most {_MOST_CELLS}, {_MOST_RAYS} and {_MOST_ROBOTS} can be stored",
        )
        require(self.runs + self.placements > 0, "both runs and placements are 0; there is nothing to collect")
        for name in ("distance", "gain", "max_speed", "speed_limit", "step_period"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"{name} is {value}; it must be positive and finite")
        expert_variant(self.teacher)
        require(
            len(self.jitter) > 0 and all(0 <= deviation < np.inf for deviation in self.jitter),
            f"jitter is {self.jitter}; one or more finite deviations that are not negative are needed",
        )
        require(
            0 <= self.validation_share <= 1,
            f"validation_share is {self.validation_share}; it must lie in [0, 1]",
        )

    @property
    def blocks(self) -> int:
        """Blocks of random placements."""
        return -(-self.placements // self.block_placements)

    @property
    def all_runs(self) -> int:
        """Roll-outs and blocks of placements together."""
        return self.runs + self.blocks

    @property
    def records(self) -> int:
        """Records in the whole data set."""
        return self.runs * self.steps + self.placements

    @property
    def maps(self) -> int:
        """Maps in the whole data set."""
        return self.records * self.robots

    @property
    def shards(self) -> int:
        """Shard files of the whole data set."""
        return -(-self.all_runs // self.shard_runs)

    def shard_range(self, shard: int) -> range:
        """Runs in a shard."""
        return range(shard * self.shard_runs, min((shard + 1) * self.shard_runs, self.all_runs))

    def is_roll_out(self, run: int) -> bool:
        """Whether a run is a roll-out rather than a block of random placements."""
        return run < self.runs

    def run_records(self, run: int) -> int:
        """Records of a run."""
        if self.is_roll_out(run):
            return self.steps
        return min(self.block_placements, self.placements - (run - self.runs) * self.block_placements)

    def groups(self, run: int) -> list[range]:
        """Steps of a run in each of its Parquet row groups; no row group holds two runs."""
        count = self.run_records(run)
        return [range(begin, min(begin + self.group_records, count)) for begin in range(0, count, self.group_records)]

    def start_seed(self, *, placements: bool) -> int:
        """Seed of the random placements, or of the starts of the roll-outs."""
        stream = _PLACEMENTS if placements else _ROLL_OUT_STARTS
        return int(np.random.SeedSequence([self.seed, stream]).generate_state(1, np.uint64)[0])

    def jitter_generator(self, run: int) -> np.random.Generator:
        """Random numbers for the jitter of one roll-out."""
        return np.random.default_rng([self.seed, _JITTER, run])

    def validation_runs(self) -> IntArray:
        """Runs held out for validation, ascending: the share of the roll-outs and of the blocks, each rounded."""
        generator = np.random.default_rng([self.seed, _SPLIT])
        chosen = [
            first + generator.permutation(count)[: round(count * self.validation_share)]
            for first, count in ((0, self.runs), (self.runs, self.blocks))
        ]
        return np.sort(np.concatenate(chosen)).astype(np.int64)

    def to_json(self) -> dict[str, Any]:
        """The configuration as plain JSON values."""
        return asdict(self) | {"jitter": list(self.jitter)}


def config_from_json(values: object) -> CollectionConfig:
    """Rebuild a configuration from ``CollectionConfig.to_json``.

    Raises:
        ConfigurationError: If a value is missing, unknown, of the wrong kind or not allowed.
    """
    return decode_dataclass(CollectionConfig, values, "configuration")


#: That of the paper, 600 roll-outs of 1000 steps and 400,000 random placements of seven robots, and a small one of the
#: same make, collected in seconds.
PRESETS = {
    "paper": CollectionConfig(),
    "quick": CollectionConfig(
        runs=20, steps=100, placements=2000, block_placements=100, shard_runs=5, group_records=50
    ),
}
