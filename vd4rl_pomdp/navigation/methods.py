"""What is compared on the mazes, by name: the paper's objectives, and what its tables are read against."""

OBJECTIVES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a")
UNTRAINED = "random"
SUPERVISED = ("supervised", "supervised+a")
REFERENCES = (UNTRAINED, *SUPERVISED)
"""What a table is read against: mik+a's network untrained; ah's and ah+a's trained on the true states themselves."""
METHOD_NAMES = (*OBJECTIVES, *REFERENCES)
"""The paper's objectives, the floor and the ceilings."""
