"""The paper's theory in exact arithmetic: finite worlds small enough to enumerate, and what their enumeration says."""

from vd4rl_pomdp.studies.theory.study import theory_study
from vd4rl_pomdp.studies.theory.world import World, finite_world

__all__ = ["World", "finite_world", "theory_study"]
