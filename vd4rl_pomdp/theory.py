"""Public path of the finite worlds; the code is in `vd4rl_pomdp.studies.theory`."""

import sys

from vd4rl_pomdp.studies import theory
from vd4rl_pomdp.studies.theory import classifiers

sys.modules |= {__name__: theory, f"{__name__}.classifiers": classifiers, f"{__name__}.views": classifiers}
