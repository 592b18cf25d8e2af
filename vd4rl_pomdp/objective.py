"""Public path of what a method of your own is derived from; the code is in `vd4rl_pomdp.nn.objective`."""

from vd4rl_pomdp.nn.objective import *  # noqa: F403
