"""Baselines, one file each, on the library's contracts."""

import vd4rl_pomdp  # noqa: F401, before torch: it says how torch's threads wait
from baselines.acro import ACRO, ACROOptions
from baselines.curl import CURL
from baselines.driml import DRIML, DRIMLOptions
from baselines.homer import HOMER, HOMEROptions
from baselines.one_step_inverse import OneStepInverse

__all__ = ["ACRO", "CURL", "DRIML", "HOMER", "ACROOptions", "DRIMLOptions", "HOMEROptions", "OneStepInverse"]
