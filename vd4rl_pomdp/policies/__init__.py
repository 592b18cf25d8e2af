"""State-based behaviour policies that collect the data."""

from vd4rl_pomdp.policies.actor import Actor, Ladder, load_actor, load_ladder, read_actor

__all__ = ["Actor", "Ladder", "load_actor", "load_ladder", "read_actor"]
