"""Exit with 0 if a task can be rendered here."""

from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.make import make_env

if make_env(TASKS["walker_walk"]).reset(0).frame is None:
    raise SystemExit(1)
