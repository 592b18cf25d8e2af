"""Sweeps: grids of runs, carried out by an executor, and gone on with wherever they were cut."""
