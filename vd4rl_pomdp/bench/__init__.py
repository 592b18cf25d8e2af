"""Speed and memory of every stage, as ratios within one run, which vary less than times on a noisy machine."""
