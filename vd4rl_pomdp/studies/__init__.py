"""Experiments beside the benchmark: mazes, exact theory, control from hidden coordinates."""
