"""The paper's navigation experiment (section 4.1): data of four mazes, observations, measures and methods by name."""
