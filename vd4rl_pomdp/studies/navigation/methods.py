"""What is compared on the mazes, by name: the paper's objectives, and what its tables are read against."""

OBJECTIVES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
UNTRAINED = "random"
WITH_MEMORY = ("supervised", "supervised+a")
SUPERVISED = ("supervised_picture", *WITH_MEMORY)
REFERENCES = (UNTRAINED, *SUPERVISED)
"""What a table is read against: mik+a's network untrained; no_history's, ah's and ah+a's trained on the true states."""
METHOD_NAMES = (*OBJECTIVES, *REFERENCES)
"""The paper's objectives, the floor and the ceilings."""
