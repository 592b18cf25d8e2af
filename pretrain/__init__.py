"""Stage one: representation learning from pixels and actions, without rewards."""

import vd4rl_pomdp  # noqa: F401, before torch: it configures how torch's threads wait
