"""The navigation experiment's model: the objectives of `pretrain`, trained on mazes beside a state probe."""
