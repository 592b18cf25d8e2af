"""V-D4RL data: format, store, data sets, views, samplers, collection and download."""

from vd4rl_pomdp.data.dataset import Dataset, open_dataset
from vd4rl_pomdp.data.view import StateView, TransitionSampler, View, WindowSampler

__all__ = ["Dataset", "StateView", "TransitionSampler", "View", "WindowSampler", "open_dataset"]
