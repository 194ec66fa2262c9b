"""Shapes of policy networks: the Vision Transformer, and what it is compared with."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from triform.decode import decode_fields
from triform.types import ConfigurationError, MapConfig, choose, convert_fields, require

#: Largest count in a shape; larger ones are mistakes, and would fill the memory before they are found out.
_MOST = 4096


class _Shape:
    """Base of all shapes: counts are within limits, and a network fits maps unless it reads others."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            require(
                each.type != "int" or 1 <= value <= _MOST,
                f"network {each.name} is {value}; it must be at least 1 and at most {_MOST}",
            )

    def fits(self, _config: MapConfig) -> bool:
        """Whether the network can stand beside maps of this configuration."""
        return True


@dataclass(frozen=True)
class _MapShape(_Shape):
    """Base of the shapes of networks that read occupancy maps, patch by patch."""

    map_size: int = 100
    patch: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.map_size % self.patch == 0,
            f"a map of {self.map_size} cells does not divide into patches of {self.patch}",
        )

    @property
    def columns(self) -> int:
        """Patches along each side of a map."""
        return self.map_size // self.patch

    @property
    def patches(self) -> int:
        """Patches of a whole map."""
        return self.columns**2

    def fits(self, config: MapConfig) -> bool:
        """Whether the network reads maps of this configuration."""
        return self.map_size == config.size


@dataclass(frozen=True)
class NetworkConfig(_MapShape):
    """Shape of the Vision Transformer; the defaults are the paper's network.

    Attributes:
        map_size: Cells along each side of the occupancy map.
        patch: Cells along each side of a patch.
        dim: Embedding dimension D.
        depth: Encoder layers.
        heads: Attention heads.
        mlp: Hidden width of the encoder's and the output's MLPs.
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of an exploration noise.
        attention: ``occupied`` computes only the patches that hold something; ``all`` is the paper's own variant.
    """

    dim: int = 256
    depth: int = 3
    heads: int = 8
    mlp: int = 512
    outputs: int = 3
    attention: Literal["occupied", "all"] = "occupied"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.dim % self.heads == 0, f"dim {self.dim} does not divide into {self.heads} heads")
        require(
            self.attention in ("occupied", "all"),
            f"attention is {self.attention!r}; it must be 'occupied' or 'all'",
        )

    @property
    def token_width(self) -> int:
        """Numbers that describe a patch in the end."""
        return self.dim


@dataclass(frozen=True)
class CnnConfig(_MapShape):
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
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of an exploration noise.
    """

    stem: int = 32
    channels: int = 48
    depth: int = 3
    squeeze: int = 16
    dim: int = 96
    mlp: int = 192
    outputs: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.patch % 2 == 0, f"patch is {self.patch}; it must be even, because it is halved once")

    @property
    def attention(self) -> Literal["occupied"]:
        """Which patches are packed; empty ones are filled in again."""
        return "occupied"

    @property
    def token_width(self) -> int:
        """Numbers that describe a patch in the end."""
        return self.channels


@dataclass(frozen=True)
class GnnConfig(_Shape):
    """Shape of a graph network whose robots talk to each other.

    It knows more than a robot with a LiDAR: true positions and headings of all within ``reach``, also behind others,
    and in every round what its neighbours have gathered, so in the end about robots ``rounds`` times as far away.

    Attributes:
        dim: Numbers that a robot sends, and that describe an edge.
        rounds: Rounds of messages.
        mlp: Hidden width of all MLPs.
        outputs: Numbers per command: u_x, u_y, omega and, where learned, the amplitude of an exploration noise.
        reach: Robots within this distance hear each other [d*]; 2.1 is how far a LiDAR of 2 d* shows centres of robots.
    """

    dim: int = 80
    rounds: int = 3
    mlp: int = 144
    outputs: int = 4
    reach: float = 2.1

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 < self.reach <= _MOST, f"reach is {self.reach} d*; it must be positive and at most {_MOST} d*")

    @property
    def token_width(self) -> int:
        """Numbers that describe an edge in the end."""
        return self.dim


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


def read_network(described: object) -> Network:
    """Read what ``describe_network`` wrote; a description without a kind is a Vision Transformer's.

    Raises:
        ConfigurationError: If it is no description, there is no such kind, or its shape is impossible.
    """
    if not isinstance(described, dict):
        raise ConfigurationError("it describes no network")
    values = dict(described)
    shape = choose("network of kind", str(values.pop("kind", "vit")), _KINDS)
    return shape(**decode_fields(shape, values, "network"))


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
