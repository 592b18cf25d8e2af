"""The paper's navigation experiment (section 4.1): four mazes, their data, exogenous noise, and its tables."""
