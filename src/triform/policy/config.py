"""Shapes of policy networks: the Vision Transformer, and what it is compared with."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from triform.types import ConfigurationError, MapConfig, require


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the Vision Transformer; the defaults are the paper's network.

    Attributes:
        map_size: Cells along each side of the occupancy map.
        patch: Cells along each side of a patch.
        dim: Embedding dimension D.
        depth: Encoder layers.
        heads: Attention heads.
        mlp: Hidden width of the encoder's and the output's MLPs.
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of a exploration noise.
        attention: ``occupied`` computes only the patches that hold something; ``all`` is the paper's own variant.
    """

    map_size: int = 100
    patch: int = 10
    dim: int = 256
    depth: int = 3
    heads: int = 8
    mlp: int = 512
    outputs: int = 3
    attention: Literal["occupied", "all"] = "occupied"

    def __post_init__(self) -> None:
        _check_positive(self, "map_size", "patch", "dim", "depth", "heads", "mlp", "outputs")
        require(
            self.map_size % self.patch == 0,
            f"a map of {self.map_size} cells does not divide into patches of {self.patch}",
        )
        require(self.dim % self.heads == 0, f"dim {self.dim} does not divide into {self.heads} heads")
        require(
            self.attention in ("occupied", "all"),
            f"attention is {self.attention!r}; it must be 'occupied' or 'all'",
        )

    @property
    def patches(self) -> int:
        """Patches of a whole map."""
        return (self.map_size // self.patch) ** 2

    @property
    def token_width(self) -> int:
        """Numbers that describe a patch in the end."""
        return self.dim

    def fits(self, config: MapConfig) -> bool:
        """Whether the network reads maps of this configuration."""
        return self.map_size == config.size


@dataclass(frozen=True)
class CnnConfig:
    """Shape of a convolutional network on the same maps as the Vision Transformer's.

    Two strided convolutions make one cell of a grid of every patch, ``depth`` residual ones mix the cells, and an MLP
    reads them all. So the network has one set of features per patch too, and learns from the same auxiliary targets.

    Attributes:
        map_size: Cells along each side of the occupancy map.
        patch: Cells along each side of a patch, which becomes one cell of the grid; an even number.
        stem: Channels after the first strided convolution, which has two cells along each side of a patch.
        channels: Channels of the grid.
        depth: Residual convolutions on the grid.
        squeeze: Channels of the grid that the map's features are read from.
        dim: Features of a map.
        mlp: Hidden width of the output's MLP.
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of a exploration noise.
    """

    map_size: int = 100
    patch: int = 10
    stem: int = 32
    channels: int = 48
    depth: int = 3
    squeeze: int = 16
    dim: int = 96
    mlp: int = 192
    outputs: int = 4

    def __post_init__(self) -> None:
        _check_positive(self, "map_size", "patch", "stem", "channels", "depth", "squeeze", "dim", "mlp", "outputs")
        require(
            self.map_size % self.patch == 0,
            f"a map of {self.map_size} cells does not divide into patches of {self.patch}",
        )
        require(self.patch % 2 == 0, f"patch is {self.patch}; it must be even, because it is halved once")

    @property
    def attention(self) -> Literal["occupied"]:
        """Which patches are packed; empty ones are filled in again."""
        return "occupied"

    @property
    def columns(self) -> int:
        """Cells along each side of the grid."""
        return self.map_size // self.patch

    @property
    def patches(self) -> int:
        """Patches of a whole map."""
        return self.columns**2

    @property
    def token_width(self) -> int:
        """Numbers that describe a patch in the end."""
        return self.channels

    def fits(self, config: MapConfig) -> bool:
        """Whether the network reads maps of this configuration."""
        return self.map_size == config.size


@dataclass(frozen=True)
class GnnConfig:
    """Shape of a graph network whose robots talk to each other.

    It knows more than a robot with a LiDAR: true positions and headings of all within ``reach``, also behind others,
    and in every round what its neighbours have gathered, so in the end about robots ``rounds`` times as far away.

    Attributes:
        dim: Numbers that a robot sends, and that describe an edge.
        rounds: Rounds of messages.
        mlp: Hidden width of all MLPs.
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of a exploration noise.
        reach: Robots within this distance hear each other [d*]; 2.1 is how far a LiDAR of 2 d* shows centres of robots.
    """

    dim: int = 80
    rounds: int = 3
    mlp: int = 144
    outputs: int = 4
    reach: float = 2.1

    def __post_init__(self) -> None:
        _check_positive(self, "dim", "rounds", "mlp", "outputs")
        require(0 < self.reach < float("inf"), f"reach is {self.reach} d*; it must be positive and finite")

    @property
    def token_width(self) -> int:
        """Numbers that describe an edge in the end."""
        return self.dim

    def fits(self, _config: MapConfig) -> bool:
        """Whether the network can stand beside maps of this configuration; it reads none."""
        return True


#: Networks that read occupancy maps.
MapNetwork = NetworkConfig | CnnConfig
Network = MapNetwork | GnnConfig
_KINDS: dict[str, type[NetworkConfig] | type[CnnConfig] | type[GnnConfig]] = {
    "vit": NetworkConfig,
    "cnn": CnnConfig,
    "gnn": GnnConfig,
}


def describe_network(network: Network) -> dict[str, Any]:
    """Kind and shape of a network, plain JSON values."""
    (kind,) = (name for name, shape in _KINDS.items() if isinstance(network, shape))
    return {"kind": kind, **asdict(network)}


def read_network(described: dict[str, Any]) -> Network:
    """Read what ``describe_network`` wrote; a description without a kind is a Vision Transformer's.

    Raises:
        ConfigurationError: If there is no such kind, or its shape is impossible.
        TypeError: If it is no description.
    """
    values = dict(described)
    kind = values.pop("kind", "vit")
    if kind not in _KINDS:
        raise ConfigurationError(f"there is no network of kind {kind!r}; there are {', '.join(_KINDS)}")
    return _KINDS[kind](**values)


def map_network(network: Network) -> MapNetwork:
    """The same network, known to read maps.

    Raises:
        ConfigurationError: If it reads none.
    """
    if isinstance(network, GnnConfig):
        raise ConfigurationError("a graph network drives teams that talk to each other; it reads no occupancy maps")
    return network


def vit_network(network: Network) -> NetworkConfig:
    """The same network, known to be a Vision Transformer.

    Raises:
        ConfigurationError: If it is of another kind.
    """
    if not isinstance(network, NetworkConfig):
        raise ConfigurationError("a Vision Transformer is needed, and this network is of another kind")
    return network


def _check_positive(config: Network, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        require(value >= 1, f"network {name} is {value}; it must be at least 1")
