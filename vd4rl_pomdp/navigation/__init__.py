"""The paper's navigation experiment (section 4.1): data of four mazes, what a model is shown, and methods by name."""
