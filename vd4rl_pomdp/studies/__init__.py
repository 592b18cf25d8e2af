"""Experiments beside the benchmark: mazes, exact theory."""
