"""`python -m vd4rl_pomdp` is `vd4rl-pomdp`."""

from vd4rl_pomdp.cli import main

if __name__ == "__main__":
    main()
