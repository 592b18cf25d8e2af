"""Foundations that everything else imports: the time axis, errors, random streams, plug-in registries and options."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("vd4rl-pomdp")
except PackageNotFoundError:  # running from a source tree that is not installed
    __version__ = "0+unknown"
