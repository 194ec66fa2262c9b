"""Teams of robots that form a triangulation, each seeing only its own 2-D LiDAR."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("triform")
except PackageNotFoundError:
    __version__ = "0+unknown"
