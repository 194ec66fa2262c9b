"""Version of the package."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("triform")
except PackageNotFoundError:
    __version__ = "0+unknown"
