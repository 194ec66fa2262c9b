"""How a policy reads one scan: its occupancy map, the attention over it, and what each group of cells is to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from triform.control import weights_folder
from triform.control.learned import to_twists
from triform.control.scan_packer import ScanPacker
from triform.perception import label_groups
from triform.policy import AttentionReader, NetworkConfig, PackedMaps, PolicyRuntime, map_network, pack
from triform.types import BoolArray, ConfigurationError, FloatArray, IntArray, MapArray, ScanConfig

#: A group that gets at least this share of the attention is what the network takes for a neighbour.
NEIGHBOUR = 0.1


@dataclass(frozen=True, eq=False)
class Groups:
    """The connected groups of cells of a map, G of them.

    Attributes:
        centres: Means of their cells in the robot's frame [m], shape (G, 2).
        radii: How far their cells are from there at most [m], shape (G,).
        attention: Share of the attention on patches that hold a cell of theirs, shape (G,); ``NaN`` where the network
            has none.
        changes: How far the velocity that the network wants goes if the group is taken away [m/s], shape (G,).
    """

    centres: FloatArray
    radii: FloatArray
    attention: FloatArray
    changes: FloatArray

    @property
    def neighbours(self) -> BoolArray:
        """Which of them the network takes for neighbours, shape (G,)."""
        neighbours: BoolArray = self.attention >= NEIGHBOUR
        return neighbours


@dataclass(frozen=True, eq=False)
class Reading:
    """What a policy makes of one scan.

    Attributes:
        occupancy: The occupancy map, shape (H, W).
        patch: Cells along a side of a patch.
        cell: Side of a cell [m].
        attention: Share of the attention on every patch, shape (H / patch, W / patch); ``None`` where the network has
            none, or another controller steers.
        groups: What the groups of cells are to the network; ``None`` where another controller steers.
        twist: The velocity that the network wants, without exploration noise [m/s, m/s, rad/s], shape (3,); ``None``
            where another controller steers.
    """

    occupancy: MapArray
    patch: int
    cell: float
    attention: FloatArray | None
    groups: Groups | None
    twist: FloatArray | None


class PolicyReader:
    """Reads scans as a stored policy does."""

    def __init__(self, weights: str | None) -> None:
        """Load a policy by its shipped name or its folder; the default one if ``None``.

        Raises:
            TriformError: There is no such policy, or it cannot be loaded.
        """
        folder = weights_folder(weights)
        self._runtime = PolicyRuntime(folder)
        self._spec = self._runtime.spec
        self._network = map_network(self._spec.network)
        self._attention = AttentionReader(folder) if isinstance(self._network, NetworkConfig) else None
        self._packers: dict[tuple[ScanConfig, float], ScanPacker] = {}

    def read(
        self, ranges: FloatArray, odometry: FloatArray | None, scan: ScanConfig, distance: float, steers: bool
    ) -> Reading | None:
        """Return how the policy reads a scan; ``None`` if it can make no map of such scans.

        Args:
            ranges: Ranges [m], shape (R,).
            odometry: Pose of the robot now in its body frame at the moment of the scan [m, m, rad], shape (3,).
            scan: The LiDAR.
            distance: Prescribed neighbour distance d* [m].
            steers: Whether the policy steers the robot; otherwise the map alone is made.
        """
        network = self._network
        try:
            used, config = self._spec.views(scan, distance)
        except ConfigurationError:
            return None
        key = scan, distance
        if key not in self._packers:
            self._packers[key] = ScanPacker(used, config, network.patch, network.attention)
        packed = self._packers[key].pack(ranges[None], None if odometry is None else odometry[None])
        occupancy = _unpacked(packed, network.columns, network.patch)
        if not steers:
            return Reading(occupancy, network.patch, config.cell, None, None, None)
        attention = None
        if self._attention is not None:
            _, shares = self._attention.read(packed)
            attention = shares.reshape(network.columns, network.columns)
        labels, count = label_groups(occupancy)
        without = np.stack([occupancy, *(np.where(labels == group, 0, occupancy) for group in range(1, count + 1))])
        answers = self._runtime.commands(pack(without.astype(np.uint8), network.patch, network.attention))
        twists = to_twists(answers, None, self._spec, self._spec.scale(distance))
        changes = np.linalg.norm(twists[1:, :2] - twists[0, :2], axis=1)
        groups = _groups(labels, count, attention, changes, network.patch, config.cell)
        return Reading(occupancy, network.patch, config.cell, attention, groups, twists[0].copy())


def _unpacked(packed: PackedMaps, columns: int, patch: int) -> MapArray:
    """Return one packed map as it was, shape (columns * patch, columns * patch)."""
    blocks = np.zeros((columns * columns, patch, patch), dtype=np.uint8)
    blocks[packed.positions] = packed.patches.reshape(-1, patch, patch)
    grid = blocks.reshape(columns, columns, patch, patch).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(grid.reshape(columns * patch, columns * patch))


def _groups(
    labels: IntArray, count: int, attention: FloatArray | None, changes: FloatArray, patch: int, cell: float
) -> Groups:
    centres, radii, shares = np.zeros((count, 2)), np.zeros(count), np.full(count, np.nan)
    for group in range(count):
        cells = np.argwhere(labels == group + 1)
        places = (cells + 0.5 - len(labels) / 2) * cell
        centres[group] = places.mean(axis=0)
        radii[group] = np.linalg.norm(places - centres[group], axis=1).max()
        if attention is not None:
            rows, columns = np.unique(cells // patch, axis=0).T
            shares[group] = attention[rows, columns].sum()
    return Groups(centres, radii, shares, changes)


@lru_cache(maxsize=4)
def policy_reader(weights: str | None) -> PolicyReader:
    """Return the reader of a policy, loaded once."""
    return PolicyReader(weights)
