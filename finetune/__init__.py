"""Stage two: offline reinforcement learning on frozen representations."""

import vd4rl_pomdp  # noqa: F401, before torch: it says how torch's threads wait
