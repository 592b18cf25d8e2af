"""Conformance checks for user-defined parts: one line in your tests checks a part that is registered by name.

    from vd4rl_pomdp.testing import check_method

    def test_my_method():
        check_method("past_to_frame")

Each function builds the part at a small size, runs every check of its kind, and raises an AssertionError that says
which promise is broken and how. An unknown name or option, or one with the name of another setting, raises UserError.
"""

from vd4rl_pomdp.testing.algorithms import check_algorithm
from vd4rl_pomdp.testing.corruptions import check_corruption
from vd4rl_pomdp.testing.frame_encoders import check_frame_encoder
from vd4rl_pomdp.testing.memories import check_memory
from vd4rl_pomdp.testing.methods import check_method
from vd4rl_pomdp.testing.tasks import check_task

__all__ = ["check_algorithm", "check_corruption", "check_frame_encoder", "check_memory", "check_method", "check_task"]
