"""Baselines, one file each, on the library's contracts."""

from baselines.acro import ACRO

__all__ = ["ACRO"]
