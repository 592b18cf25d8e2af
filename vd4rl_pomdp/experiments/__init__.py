"""Experiments as data: lists of stage commands and what to measure."""
