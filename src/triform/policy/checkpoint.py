"""Policies on disk: a folder with ``model.safetensors``, ``model.json`` and, once exported, ``model.onnx``.

``model.json`` carries what a policy cannot run without: the network's shape and the scan and map that it was trained
with. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from triform.files import sha256
from triform.policy.config import NetworkConfig
from triform.types import ConfigurationError, MapConfig, Scan, ScanConfig, TriformError, require

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
        network: Shape of the network.
        scan: The LiDAR of its training.
        map: The occupancy map of its training.
        distance: Prescribed neighbour distance d* of its training [m].
        training: How it was trained, for the record: preset, teacher, seed, maps.
        weights_sha256: Checksum of the weights that belong to this description.
        onnx_sha256: Checksum of the exported graph; empty before the export.
        precision: Numbers in which the exported graph computes its linear layers.
    """

    network: NetworkConfig
    scan: ScanConfig
    map: MapConfig
    distance: float = 1.0
    training: dict[str, Any] = field(default_factory=dict)
    weights_sha256: str = ""
    onnx_sha256: str = ""
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        require(
            self.network.fits(self.map),
            f"the network reads maps of {self.network.map_size} cells, the map configuration has {self.map.size}",
        )
        require(
            self.precision in get_args(Precision),
            f"precision is {self.precision!r}; it must be {' or '.join(get_args(Precision))}",
        )

    def check_scan(self, scan: Scan) -> None:
        """Refuse scans that make other maps than those of the training.

        What enters the network is the map, so the range must be that of the training, and neighbouring rays at
        that range must lie no more than a cell apart; given that, their number is free.

        Raises:
            ConfigurationError: If the scan does not fit.
        """
        given = scan.config
        if given.range_max != self.scan.range_max:
            raise ConfigurationError(
                f"the policy was trained with a sensing range of {self.scan.range_max} m; "
                f"this scan has range_max {given.range_max} m"
            )
        if given.angle_increment * given.range_max > self.map.cell and given.rays < self.scan.rays:
            raise ConfigurationError(
                f"the policy was trained with {self.scan.rays} rays and cells of {self.map.cell} m; this scan has "
                f"{given.rays} rays, which lie more than a cell apart at {given.range_max} m"
            )

    def to_json(self) -> str:
        """Serialise to JSON."""
        return json.dumps({"format": _FORMAT, "version": _VERSION, **asdict(self)}, indent=2) + "\n"

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
                network=NetworkConfig(**data.pop("network")),
                scan=ScanConfig(**data.pop("scan")),
                map=MapConfig(**data.pop("map")),
                **data,
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if isinstance(error, TriformError):
                raise
            raise TriformError(f"{source} is not a readable policy description: {error}") from error


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


def check_graph(folder: Path, spec: PolicySpec) -> Path:
    """Path of the exported graph of the policy in ``folder``, checked against its description.

    Raises:
        TriformError: If there is none, or it is not the one that was exported with these weights.
    """
    path = folder / ONNX_FILE
    if not path.exists() or not spec.onnx_sha256:
        raise TriformError(f"{folder} holds no exported policy; make it with: triform export {folder}")
    _read_checked(path, spec.onnx_sha256, "graph")
    return path


def _read_checked(path: Path, checksum: str, what: str) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TriformError(f"cannot read the {what} {path}: {error.strerror}") from error
    if sha256(data) != checksum:
        raise TriformError(f"the {what} {path} is damaged or belongs to another policy: its checksum differs")
    return data
