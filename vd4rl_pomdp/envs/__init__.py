"""Environments: dm_control pixels as the data shows them, with the corruptions of the benchmark."""
