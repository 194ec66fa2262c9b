"""From a scan to an occupancy map (Algorithm 3)."""

from triform.perception.occupancy import occupancy_maps, occupied_into

__all__ = ["occupancy_maps", "occupied_into"]
