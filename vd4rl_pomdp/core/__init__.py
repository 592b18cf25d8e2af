"""Ground of the house: the time axis, errors, named random streams, parts and their options."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("vd4rl-pomdp")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
