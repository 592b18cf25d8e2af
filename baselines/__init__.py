"""Baseline methods, one file each, built on `vd4rl_pomdp.nn.objective`."""

import vd4rl_pomdp  # noqa: F401, before torch: it configures how torch's threads wait
from baselines.acdf import ACDF, ACDFOptions
from baselines.acro import ACRO, ACROOptions
from baselines.curl import CURL
from baselines.driml import DRIML, DRIMLOptions
from baselines.homer import HOMER, HOMEROptions
from baselines.one_step_inverse import OneStepInverse
from baselines.smwm import SMWM, SMWMOptions

__all__ = [
    "ACDF",
    "ACRO",
    "CURL",
    "DRIML",
    "HOMER",
    "SMWM",
    "ACDFOptions",
    "ACROOptions",
    "DRIMLOptions",
    "HOMEROptions",
    "OneStepInverse",
    "SMWMOptions",
]
