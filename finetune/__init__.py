"""Stage two: offline reinforcement learning on frozen representations."""
