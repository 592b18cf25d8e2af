"""Control from memory on simulator states, of which some are hidden: what pixels tell in hours, told in minutes.

The package's own objectives, GRU and TD3+BC, on physics alone; nothing is drawn.
"""
