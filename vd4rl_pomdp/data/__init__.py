"""V-D4RL data: format, store, data sets, samplers, collection and download."""

from vd4rl_pomdp.data.dataset import Dataset, open_dataset
from vd4rl_pomdp.data.samplers import TransitionSampler, WindowSampler

__all__ = ["Dataset", "TransitionSampler", "WindowSampler", "open_dataset"]
