"""Pictures of trajectories, of the maps of a pair, and of what a network looks at."""
