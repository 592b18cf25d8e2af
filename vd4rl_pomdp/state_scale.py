"""Public path of the scale of simulator states; the code is in `vd4rl_pomdp.core.state_scale`."""

from vd4rl_pomdp.core.state_scale import *  # noqa: F403
