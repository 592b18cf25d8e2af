"""Speed and memory of every stage as ratios measured in one run, so that a noisy machine cannot bend them much."""
