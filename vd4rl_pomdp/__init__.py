"""Which representations survive partial observability in offline visual reinforcement learning."""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vd4rl_pomdp.data import open_dataset

try:
    __version__ = version("vd4rl-pomdp")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__", "open_dataset"]


def __getattr__(name: str) -> object:
    if name == "open_dataset":
        from vd4rl_pomdp.data import open_dataset

        return open_dataset
    raise AttributeError(f"module 'vd4rl_pomdp' has no attribute {name!r}")
