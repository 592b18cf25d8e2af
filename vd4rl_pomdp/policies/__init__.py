"""State-based policies that collect the data."""

from vd4rl_pomdp.policies.actor import Actor, load_actor, read_actor

__all__ = ["Actor", "load_actor", "read_actor"]
