"""`python -m finetune` is `vd4rl-pomdp finetune`."""

import sys

from vd4rl_pomdp.cli import main

if __name__ == "__main__":
    main(["finetune", *sys.argv[1:]])
