"""From a scan to an occupancy map (Algorithm 3)."""

from triform.perception.occupancy import (
    MapRules,
    MapWorkspace,
    label_groups,
    map_rules,
    map_workspace,
    occupancy_maps,
    occupied_into,
)

__all__ = [
    "MapRules",
    "MapWorkspace",
    "label_groups",
    "map_rules",
    "map_workspace",
    "occupancy_maps",
    "occupied_into",
]
