"""Policies on disk: a folder with a description, ``model.json``, the weights and, once exported, the graph.

``model.json`` carries what a policy cannot run without: the network's shape and the scan and map that it was trained
with. It also says which weights and graph belong to it: files of other content have other names, so replacing
``model.json`` replaces the whole policy at once. Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from triform.decode import checksum, decode_fields, decode_json
from triform.files import exclusive, make_folder, remove_temporaries, sha256, write_atomically
from triform.policy.config import GnnConfig, Network, describe_network, read_network
from triform.types import ConfigurationError, MapConfig, ScanConfig, TriformError, convert_fields, require

_FORMAT = "triform-policy"
#: Of descriptions that are written; those of version 1, which have no checksum of their own, are read too.
_VERSION = 2
SPEC_FILE = "model.json"
#: Weights of policies that were written before names said what is in a file.
PLAIN_WEIGHTS = "model.safetensors"
#: Names of weights and graphs, old ones included.
_DATA_FILE = re.compile(r"model(-[0-9a-f]{16})?\.(safetensors|onnx)")
#: Faster robots, and farther distances, are mistakes of a unit [m/s, m].
_FASTEST, _FARTHEST = 10.0, 1000.0
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
        for name in ("weights_sha256", "onnx_sha256"):
            require(
                re.fullmatch("([0-9a-f]{64})?", getattr(self, name)) is not None,
                f"{name} is {getattr(self, name)!r}; 64 hexadecimal digits are needed",
            )
        require(
            self.precision in get_args(Precision),
            f"precision is {self.precision!r}; it must be {' or '.join(get_args(Precision))}",
        )
        require(
            self.precision == "float32" or not isinstance(self.network, GnnConfig),
            "a graph network is exported in float32 only, because 8 bits are rounded by the common range of all robots",
        )
        low, high = self.distances or (self.distance, self.distance)
        require(
            0 < low <= self.distance <= high <= _FARTHEST,
            f"distances {low} m to {high} m must hold the distance {self.distance} m and lie in (0, {_FARTHEST:g}] m",
        )
        for name in ("rest_speed", "least_push", "search_push"):
            value = getattr(self, name)
            require(0 <= value <= _FASTEST, f"{name} is {value} m/s; it must lie in [0, {_FASTEST:g}] m/s")
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
        """Serialise to JSON, with a checksum of all that it says."""
        described = json.loads(json.dumps({**asdict(self), "network": describe_network(self.network)}))
        head = {"format": _FORMAT, "version": _VERSION, "sha256": checksum(described)}
        return json.dumps({**head, **described}, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: bytes, source: str) -> PolicySpec:
        """Read what ``to_json`` wrote, or a version before wrote; ``source`` names it in errors.

        Raises:
            TriformError: If the text is not a policy's description, or not the one that was written.
        """
        described = decode_json(text, source)
        if not isinstance(described, dict) or described.pop("format", None) != _FORMAT:
            raise TriformError(f"{source} does not describe a triform policy")
        version = described.pop("version", None)
        if type(version) is not int or not 1 <= version <= _VERSION:
            raise TriformError(f"{source} has version {version!r}; this triform reads versions 1 to {_VERSION}")
        if version == _VERSION and described.pop("sha256", None) != checksum(described):
            raise TriformError(f"{source} is damaged or was changed by hand: its checksum differs")
        try:
            network = read_network(described.pop("network", None))
            return cls(network, **decode_fields(cls, described, "it"))
        except (ConfigurationError, TypeError) as error:
            raise TriformError(f"{source} is not a readable policy description: {error}") from error


def read_spec(folder: Path) -> PolicySpec:
    """Read the description of the policy in ``folder``.

    Raises:
        TriformError: If there is none or it cannot be read.
    """
    if folder.is_file():
        raise TriformError(
            f"{folder} is a file; a policy is a folder with {SPEC_FILE}, weights and a graph "
            "(pickled checkpoints are never loaded)"
        )
    path = folder / SPEC_FILE
    try:
        text = path.read_bytes()
    except OSError as error:
        raise TriformError(f"{folder} holds no policy: cannot read {path}: {error.strerror}") from error
    return PolicySpec.from_json(text, str(path))


def weights_path(folder: Path, spec: PolicySpec) -> Path:
    """Where the weights of a policy are."""
    return _named(folder, spec.weights_sha256, "safetensors")


def graph_path(folder: Path, spec: PolicySpec) -> Path:
    """Where the exported graph of a policy is."""
    return _named(folder, spec.onnx_sha256, "onnx")


def _named(folder: Path, checksum: str, ending: str) -> Path:
    """A file of this checksum: ``model-CHECKSUM.ENDING``, or plain ``model.ENDING`` where there is none."""
    path = folder / f"model-{checksum[:16]}.{ending}"
    return path if path.exists() else folder / f"model.{ending}"


def weights_name(spec: PolicySpec) -> str:
    """Name under which the weights of a policy are written, and by which its graph refers to them."""
    return f"model-{spec.weights_sha256[:16]}.safetensors"


def write_policy(
    folder: Path, spec: PolicySpec, weights: bytes, graph: bytes = b"", instead_of: PolicySpec | None = None
) -> None:
    """Write a policy into ``folder``; the one that was there stays whole until it is replaced at once.

    Args:
        folder: Where to; created if need be.
        spec: Description of the policy; its checksums are set.
        weights: Content of its safetensors file.
        graph: Its exported graph, which refers to weights of the name ``weights_name``; empty before the export.
        instead_of: What must be in ``folder``, if anything particular must.

    Raises:
        TriformError: If a file cannot be written, or another policy than ``instead_of`` is there; it stays then.
    """
    spec = replace(spec, weights_sha256=sha256(weights), onnx_sha256=sha256(graph) if graph else "")
    make_folder(folder)
    with exclusive(folder, wait=True):
        remove_temporaries(folder)
        if instead_of is not None and read_spec(folder) != instead_of:
            raise TriformError(f"another process has replaced the policy in {folder}; run the same command again")
        try:
            write_atomically(folder / weights_name(spec), weights)
            if graph:
                write_atomically(folder / f"model-{spec.onnx_sha256[:16]}.onnx", graph)
            write_atomically(folder / SPEC_FILE, spec.to_json().encode())
        finally:
            _remove_others(folder)


def _remove_others(folder: Path) -> None:
    """Remove weights and graphs of policies that are no longer in ``folder``, or that never came to be."""
    try:
        spec = read_spec(folder)
    except TriformError:
        return
    kept = {weights_path(folder, spec), graph_path(folder, spec) if spec.onnx_sha256 else None}
    for path in folder.iterdir():
        if _DATA_FILE.fullmatch(path.name) and path not in kept:
            path.unlink(missing_ok=True)


def read_weights(folder: Path) -> tuple[PolicySpec, bytes]:
    """Read the description and the weights of the policy in ``folder``, checked against each other.

    Raises:
        TriformError: If they cannot be read, or do not belong together.
    """
    spec, weights, _ = _read(folder, exported=False)
    return spec, weights


def read_exported(folder: Path) -> tuple[PolicySpec, bytes, bytes]:
    """Read the description, the weights and the graph of the policy in ``folder``, checked against each other.

    Raises:
        TriformError: If it was not exported, or they cannot be read, or do not belong together.
    """
    return _read(folder, exported=True)


def _read(folder: Path, *, exported: bool) -> tuple[PolicySpec, bytes, bytes]:
    while True:
        spec = read_spec(folder)
        try:
            weights = _read_checked(weights_path(folder, spec), spec.weights_sha256, "weights")
            if not exported:
                return spec, weights, b""
            path = graph_path(folder, spec)
            if not path.exists() or not spec.onnx_sha256:
                raise TriformError(f"{folder} holds no exported policy; make it with: triform export {folder}")
            return spec, weights, _read_checked(path, spec.onnx_sha256, "graph")
        except TriformError:
            # Another process may have replaced the policy meanwhile.
            if read_spec(folder) == spec:
                raise


def _read_checked(path: Path, checksum: str, what: str) -> bytes:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TriformError(f"cannot read the {what} {path}: {error.strerror}") from error
    if sha256(data) != checksum:
        raise TriformError(f"the {what} {path} is damaged or belongs to another policy: its checksum differs")
    return data
