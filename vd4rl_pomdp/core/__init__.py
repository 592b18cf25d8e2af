"""Ground of the house: the time axis, errors, named random streams, parts and their options."""
