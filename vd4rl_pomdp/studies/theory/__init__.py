"""The paper's theory in exact arithmetic, by enumerating small finite worlds."""

from vd4rl_pomdp.studies.theory.study import theory_study
from vd4rl_pomdp.studies.theory.world import World, finite_world

__all__ = ["World", "finite_world", "theory_study"]
