"""Public path of the tasks and their registry; the code is in `vd4rl_pomdp.core.tasks`."""

from vd4rl_pomdp.core.tasks import *  # noqa: F403
