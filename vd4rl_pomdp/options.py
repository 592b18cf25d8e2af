"""Public path of what parts of your own take their options from; the code is in `vd4rl_pomdp.core.options`."""

from vd4rl_pomdp.core.options import *  # noqa: F403
