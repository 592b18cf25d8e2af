"""Stage one: representations from pixels and actions alone."""

import vd4rl_pomdp  # noqa: F401, before torch: it configures how torch's threads wait
