"""An episode that is over takes no further step."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs

from vd4rl_pomdp.envs import Info


class ResetAfterEnd(gymnasium.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """Raises Gymnasium's ResetNeeded for a step between the end of an episode and the next `reset`."""

    def __init__(self, env: gymnasium.Env[np.ndarray, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        self._over = False

    def reset(self, **options: Any) -> tuple[np.ndarray, Info]:
        """Begin the next episode."""
        self._over = False
        return self.env.reset(**options)

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, Info]:
        """Apply one action, unless the episode is over."""
        if self._over:
            raise ResetNeeded("the episode is over: call reset() before the next step()")
        result = self.env.step(action)
        self._over = result[2] or result[3]
        return result
