"""``headbench pareto``: quality against size and against frame time, over runs of different settings."""
