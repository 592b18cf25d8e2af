"""Exit with 0 if a task can be rendered here."""

from vd4rl_pomdp.envs.dmc import PixelEnv

if PixelEnv("walker_walk").reset(0).frame is None:
    raise SystemExit(1)
