"""Public path of the errors that users see; the code is in `vd4rl_pomdp.core.errors`."""

from vd4rl_pomdp.core.errors import *  # noqa: F403
