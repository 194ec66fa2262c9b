"""Pure geometry: frames, the Gabriel graph and the quality of a triangulation."""

from triform.geometry.frames import body_to_world, wrap_angle
from triform.geometry.gabriel import gabriel_graph, gabriel_into
from triform.geometry.quality import EDGE_TOLERANCE, Quality, assess, edge_error, list_triangles, smallest_distance

__all__ = [
    "EDGE_TOLERANCE",
    "Quality",
    "assess",
    "body_to_world",
    "edge_error",
    "gabriel_graph",
    "gabriel_into",
    "list_triangles",
    "smallest_distance",
    "wrap_angle",
]
