"""The package's version."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("vd4rl-pomdp")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
