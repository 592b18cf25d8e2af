"""Baseline methods, one file each, built on `vd4rl_pomdp.nn.objective`."""

import vd4rl_pomdp  # noqa: F401, before torch: it configures how torch's threads wait
