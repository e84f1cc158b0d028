"""Studies of a rig: its frames beside those of a simulation, and images made of them."""
