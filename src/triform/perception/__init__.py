"""From a scan to an occupancy map (Algorithm 3)."""

from triform.perception.occupancy import map_workspace, occupancy_maps, occupied_into

__all__ = ["map_workspace", "occupancy_maps", "occupied_into"]
