"""`python -m pretrain`: the same as `vd4rl-pomdp pretrain`."""

import sys

from vd4rl_pomdp.cli import main

if __name__ == "__main__":
    main(["pretrain", *sys.argv[1:]])
