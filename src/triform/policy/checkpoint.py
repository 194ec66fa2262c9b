"""Policies on disk: a folder with ``model.safetensors``, ``model.json`` and, once exported, ``model.onnx``.

``model.json`` carries what a policy cannot run without: the network's shape and the scan and map that it was trained
with. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from triform.files import sha256
from triform.policy.config import GnnConfig, Network, describe_network, read_network
from triform.types import ConfigurationError, MapConfig, ScanConfig, TriformError, convert_fields, require

_FORMAT = "triform-policy"
_VERSION = 1
WEIGHTS_FILE = "model.safetensors"
SPEC_FILE = "model.json"
ONNX_FILE = "model.onnx"
#: Numbers of an exported graph's linear layers.
Precision = Literal["float32", "int8"]


@dataclass(frozen=True)
class PolicySpec:
    """What a policy is and what it was trained with.

    Attributes:
        network: Kind and shape of the network.
        scan: The LiDAR of its training.
        map: The occupancy map of its training.
        distance: Prescribed neighbour distance d* of its training [m], for which ``scan`` and ``map`` hold.
        distances: Least and largest d* for which it was trained [m], if not for one alone: lengths and speeds are then
            those of ``distance``, and are scaled to another d*.
        rest_speed: Slower commands, exploration noise included, are none [m/s].
        least_push: Smaller amplitudes of the exploration noise are none [m/s].
        search_push: Amplitude of the push of a robot that sees nobody [m/s]; 0 asks the network.
        training: How it was trained, for the record: preset, teacher, seed, maps.
        weights_sha256: Checksum of the weights that belong to this description.
        onnx_sha256: Checksum of the exported graph; empty before the export.
        precision: Numbers in which the exported graph computes its linear layers.
    """

    network: Network
    scan: ScanConfig
    map: MapConfig
    distance: float = 1.0
    distances: tuple[float, float] | None = None
    rest_speed: float = 0.0
    least_push: float = 0.0
    search_push: float = 0.0
    training: dict[str, Any] = field(default_factory=dict)
    weights_sha256: str = ""
    onnx_sha256: str = ""
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        convert_fields(self)
        require(
            self.network.fits(self.map),
            f"the network reads maps of another size than the {self.map.size} cells of the map configuration",
        )
        require(
            self.precision in get_args(Precision),
            f"precision is {self.precision!r}; it must be {' or '.join(get_args(Precision))}",
        )
        require(
            self.precision == "float32" or not isinstance(self.network, GnnConfig),
            "a graph network is exported in float32 only, because 8 bits are rounded by the common range of all robots",
        )
        if self.distances is not None:
            low, high = self.distances
            require(
                0 < low <= self.distance <= high < math.inf,
                f"distances {low} m to {high} m must hold the distance {self.distance} m",
            )
        for name in ("rest_speed", "least_push", "search_push"):
            value = getattr(self, name)
            require(0 <= value < math.inf, f"{name} is {value} m/s; it must be finite and not negative")
        require(
            self.search_push == 0.0 or self.network.outputs == 4,
            f"search_push is {self.search_push} m/s, but the network gives no amplitude of a push",
        )

    def scale(self, distance: float) -> float:
        """Lengths for d* = ``distance`` [m] over those of the training.

        Raises:
            ConfigurationError: If the policy was not trained for it.
        """
        low, high = self.distances or (self.distance, self.distance)
        if not low <= distance <= high:
            trained = f"distances of {low} m to {high} m" if low < high else f"a distance of {low} m"
            raise ConfigurationError(f"this policy was trained for {trained}, not {distance} m")
        return distance / self.distance

    def views(self, scan: ScanConfig, distance: float) -> tuple[ScanConfig, MapConfig]:
        """What the policy uses of a scan, and the map that it makes of it, for d* = ``distance`` [m].

        It uses the range of its training, scaled to d*, so the LiDAR must reach at least as far; neighbouring rays at
        that range must lie no more than a cell apart. Given that, their number is free.

        Raises:
            ConfigurationError: If the scan or the distance does not fit.
        """
        scale = self.scale(distance)
        reach, cell = scale * self.scan.range_max, scale * self.map.cell
        if scan.range_max < reach - 1e-9:
            raise ConfigurationError(
                f"the policy needs a sensing range of {reach:g} m for a distance of {distance:g} m; this scan has "
                f"range_max {scan.range_max:g} m"
            )
        if scan.angle_increment * reach > cell and scan.rays < self.scan.rays:
            raise ConfigurationError(
                f"the policy was trained with {self.scan.rays} rays and makes cells of {cell:g} m; this scan has "
                f"{scan.rays} rays, which lie more than a cell apart at {reach:g} m"
            )
        return replace(scan, range_max=reach), replace(self.map, cell=cell)

    def to_json(self) -> str:
        """Serialise to JSON."""
        described = {**asdict(self), "network": describe_network(self.network)}
        return json.dumps({"format": _FORMAT, "version": _VERSION, **described}, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str, source: str) -> PolicySpec:
        """Read what ``to_json`` wrote; ``source`` names it in errors.

        Raises:
            TriformError: If the text is not a policy's description.
        """
        try:
            data = json.loads(text)
            if data.pop("format") != _FORMAT:
                raise TriformError(f"{source} does not describe a triform policy")
            version = data.pop("version")
            if version != _VERSION:
                raise TriformError(f"{source} has format version {version}; this release reads version {_VERSION}")
            return cls(
                network=read_network(data.pop("network")),
                scan=ScanConfig(**data.pop("scan")),
                map=MapConfig(**data.pop("map")),
                distances=_pair(data.pop("distances", None)),
                **data,
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, TriformError):
                raise
            raise TriformError(f"{source} is not a readable policy description: {error}") from error


def _pair(values: list[float] | None) -> tuple[float, float] | None:
    if values is None:
        return None
    low, high = values
    return low, high


def read_spec(folder: Path) -> PolicySpec:
    """Read the description of the policy in ``folder``.

    Raises:
        TriformError: If there is none or it cannot be read.
    """
    if folder.is_file():
        raise TriformError(
            f"{folder} is a file; a policy is a folder with {SPEC_FILE}, {WEIGHTS_FILE} and {ONNX_FILE} "
            "(pickled checkpoints are never loaded)"
        )
    path = folder / SPEC_FILE
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TriformError(f"{folder} holds no policy: cannot read {path}: {error}") from error
    return PolicySpec.from_json(text, str(path))


def read_weights(folder: Path, spec: PolicySpec) -> bytes:
    """Read the weights of the policy in ``folder``, checked against its description.

    Raises:
        TriformError: If they cannot be read, or are not those that the description was written for.
    """
    return _read_checked(folder / WEIGHTS_FILE, spec.weights_sha256, "weights")


def read_graph(folder: Path, spec: PolicySpec) -> bytes:
    """Read the exported graph of the policy in ``folder``, checked against its description.

    Raises:
        TriformError: If there is none, or it is not the one that was exported with these weights.
    """
    path = folder / ONNX_FILE
    if not path.exists() or not spec.onnx_sha256:
        raise TriformError(f"{folder} holds no exported policy; make it with: triform export {folder}")
    return _read_checked(path, spec.onnx_sha256, "graph")


def _read_checked(path: Path, checksum: str, what: str) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TriformError(f"cannot read the {what} {path}: {error.strerror}") from error
    if sha256(data) != checksum:
        raise TriformError(f"the {what} {path} is damaged or belongs to another policy: its checksum differs")
    return data
