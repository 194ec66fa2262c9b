"""Training presets: Algorithm 1 as printed, and the recipe that works."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

from triform.control import TriangulatingLaw, expert_variant
from triform.dataset import SceneConfig, StateConfig
from triform.policy import CnnConfig, GnnConfig, Network, NetworkConfig, PolicySpec
from triform.simulation import Profile
from triform.types import ConfigurationError, MapConfig, ScanConfig, convert_fields, require

Optimizer = Literal["adamw", "rmsprop"]
Schedule = Literal["cosine", "constant"]
Loss = Literal["norm", "mse"]
Precision = Literal["float32", "medium", "bfloat16"]
_CHOICES = {
    "optimizer": get_args(Optimizer),
    "schedule": get_args(Schedule),
    "loss": get_args(Loss),
    "precision": get_args(Precision),
}


@dataclass(frozen=True)
class TrainConfig:
    """One training run.

    Attributes:
        preset: Name under which it is recorded.
        network: Kind and shape of the network.
        maps: Maps to train on; ``None`` for one epoch of a stored data set.
        batch_maps: Maps of a mini-batch, about.
        optimizer: ``adamw`` or ``rmsprop``.
        learning_rate: Peak learning rate.
        schedule: ``cosine`` decays to zero, ``constant`` stays; both after the warm-up.
        warmup: Steps over which the learning rate grows from zero.
        weight_decay: Decoupled weight decay (AdamW).
        clip: Largest gradient norm; 0 leaves gradients alone.
        loss: ``norm`` is the mean Euclidean norm of the command error, ``mse`` its mean square.
        auxiliary: Weight of the auxiliary loss on tokens; 0 leaves it out.
        distance: Prescribed neighbour distance d* [m].
        teacher: Who labels the demonstrations.
        seed: Seed of weights and data.
        start: Weights to begin from: a shipped policy's name or a folder; random ones if ``None``.
        precision: Arithmetic of matrix products: ``float32`` is PyTorch's default, ``medium`` lets PyTorch choose a
            faster kind of float32 (see ``precision.py``), ``bfloat16`` also rounds what enters them. Weights, sums and
            losses are float32 throughout.
        states: Which fresh states are drawn.
        scenes: Which views are drawn to learn the triangulating law; ``None`` learns an expert from demonstrations.
        law: Constants of the triangulating law.
        rest_speed: Slower commands of the policy are none [m/s].
        least_push: Smaller amplitudes of its exploration noise are none [m/s].
        search_push: Amplitude of the push of a robot that sees nobody [m/s]; 0 asks the network.
        rounds: Shares of the steps after which the learner itself drives teams, and where it went is drawn from too.
        scan: The LiDAR; in units of d* with ``scenes``, and so is the map.
        map: The occupancy map.
    """

    preset: str
    network: Network
    maps: int | None
    batch_maps: int = 112
    optimizer: Optimizer = "adamw"
    learning_rate: float = 3e-3
    schedule: Schedule = "cosine"
    warmup: int = 200
    weight_decay: float = 0.01
    clip: float = 1.0
    loss: Loss = "norm"
    auxiliary: float = 1.0
    distance: float = 1.0
    teacher: str = "expert-odd"
    seed: int = 1
    start: str | None = None
    precision: Precision = "medium"
    states: StateConfig = field(default_factory=StateConfig)
    scenes: SceneConfig | None = None
    law: TriangulatingLaw = field(default_factory=TriangulatingLaw)
    rounds: tuple[float, ...] = ()
    rest_speed: float = 0.0
    least_push: float = 0.0
    search_push: float = 0.0
    scan: ScanConfig = field(default_factory=ScanConfig)
    map: MapConfig = field(default_factory=MapConfig)

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("maps", "batch_maps"):
            value = getattr(self, name)
            require(value is None or value >= 1, f"{name} is {value}; it must be at least 1")
        for name in ("warmup", "weight_decay", "clip", "auxiliary", "seed"):
            value = getattr(self, name)
            require(value >= 0, f"{name} is {value}; it must not be negative")
        for name, known in _CHOICES.items():
            value = getattr(self, name)
            require(value in known, f"there is no {name} {value!r}; there are {', '.join(known)}")
        require(
            0 < self.learning_rate < math.inf,
            f"learning_rate is {self.learning_rate}; it must be positive and finite",
        )
        require(self.distance > 0, f"distance is {self.distance} m; it must be positive")
        require(
            all(0 < share < 1 for share in self.rounds) and list(self.rounds) == sorted(set(self.rounds)),
            f"rounds are {self.rounds}; growing shares between 0 and 1 are needed",
        )
        require(
            self.scenes is not None or not isinstance(self.network, GnnConfig),
            "a graph network learns from whole teams, so it needs scenes",
        )
        require(
            self.scenes is not None or not self.rounds, "rounds are given, but only learning from scenes has rounds"
        )
        if self.scenes is None:
            expert_variant(self.teacher)
        else:
            require(
                self.teacher == "triangulating",
                f"the teacher is {self.teacher!r}; scenes are labelled by the triangulating law alone",
            )

    def for_robot(self, robot: Profile) -> TrainConfig:
        """Return this training with scenes of such robots: their outline, their rays, and errors as large as theirs.

        Noise and lost rays are still drawn anew for every state, up to what the scenes had or the robot has, whichever
        is larger. Scenes stand still, so its rolling LiDAR and its latency change nothing.

        Raises:
            ConfigurationError: The training draws no scenes.
        """
        if self.scenes is None:
            raise ConfigurationError(
                f"the preset {self.preset!r} draws no scenes, so it cannot be trained for the robot {robot.name!r}"
            )
        lidar = robot.lidar
        # A band is noisiest at its end, or at the farthest that a policy looks.
        reach = self.scan.range_max * self.scenes.distances[1]
        noise = [band.absolute + band.relative * min(band.up_to, reach) for band in lidar.noise]
        scenes = replace(
            self.scenes,
            footprint=robot.footprint,
            rays=(),
            noise=max([self.scenes.noise, *noise]),
            dropout=max(self.scenes.dropout, lidar.dropout),
        )
        return replace(self, scenes=scenes, scan=replace(self.scan, rays=lidar.scan.rays))

    def round_steps(self, steps: int) -> list[int]:
        """Steps at which rounds begin, and the last step, for a training of so many steps."""
        return [0, *(round(share * steps) for share in self.rounds), steps]

    def spec(self) -> PolicySpec:
        """Description of the policy that comes out of it."""
        return PolicySpec(
            self.network,
            self.scan,
            self.map,
            self.distance,
            None if self.scenes is None else self.scenes.distances,
            self.rest_speed,
            self.least_push,
            self.search_push,
            self.record(),
        )

    def record(self) -> dict[str, Any]:
        """What a checkpoint says of its training, plain JSON values."""
        values = asdict(self)
        for name in ("network", "scan", "map"):
            del values[name]
        values["states"]["robots"] = list(self.states.robots)
        return values


#: The policy that learns the triangulating law.
_DEFAULT = TrainConfig(
    "default",
    NetworkConfig(map_size=160, dim=96, depth=3, heads=4, mlp=192, outputs=4),
    maps=9_000_000,
    learning_rate=2.5e-3,
    warmup=500,
    teacher="triangulating",
    scenes=SceneConfig(rays=(360, 450, 667)),
    rounds=(0.05, 0.35, 0.65),
    rest_speed=0.015,
    least_push=0.07,
    search_push=0.5,
    scan=ScanConfig(rays=360, range_max=3.0),
    map=MapConfig(size=160),
)
#: The same with the range and the map of the paper.
_NEAR = replace(
    _DEFAULT,
    preset="near",
    network=NetworkConfig(dim=96, depth=3, heads=4, mlp=192, outputs=4),
    law=TriangulatingLaw(sight=2.1),
    scan=ScanConfig(rays=360),
    map=MapConfig(),
)

PRESETS = {
    "default": _DEFAULT,
    "near": _NEAR,
    # The published method with a recipe that works: a small network that learns an expert of springs.
    "springs": TrainConfig("springs", NetworkConfig(dim=64, depth=2, heads=4, mlp=128), maps=5_000_000),
    # The same with the paper's network.
    "large": TrainConfig("large", NetworkConfig(), maps=2_000_000, learning_rate=4e-4, warmup=500),
    # Algorithm 1 as printed: RMSprop 0.01, mini-batches of 16 records x 7 robots, one epoch, every patch attended.
    "paper": TrainConfig(
        "paper",
        NetworkConfig(attention="all"),
        maps=None,
        optimizer="rmsprop",
        learning_rate=0.01,
        schedule="constant",
        warmup=0,
        weight_decay=0.0,
        clip=0.0,
        loss="mse",
        auxiliary=0.0,
        teacher="expert",
        states=StateConfig(robots=(7,)),
    ),
    # Learns the triangulating law in minutes on one processor, and less well: of 100 runs each of 5, 9 and 13 robots,
    # 98, 88 and 67 end in a true triangulation.
    "quick": replace(
        _NEAR,
        preset="quick",
        network=NetworkConfig(dim=64, depth=2, heads=4, mlp=128, outputs=4),
        maps=300_000,
        learning_rate=3e-3,
        warmup=100,
        rounds=(0.5,),
    ),
    # What the policy `near` is compared with, trained on the same scenes in the same way: a
    # convolutional network, a graph network whose robots talk, and the paper's network, which attends to every patch.
    "cnn": replace(_NEAR, preset="cnn", network=CnnConfig()),
    "gnn": replace(_NEAR, preset="gnn", network=GnnConfig()),
    "dense": replace(
        _NEAR,
        preset="dense",
        network=NetworkConfig(outputs=4, attention="all"),
        learning_rate=4e-4,
    ),
}
