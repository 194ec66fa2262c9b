"""Teams of robots that form a triangulation, each seeing only its own 2-D LiDAR."""

from importlib.metadata import version

__version__ = version("triform")
