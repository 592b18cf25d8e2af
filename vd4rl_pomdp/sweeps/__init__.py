"""Sweeps: grids of runs, started by an executor and resumed after any interruption."""
