"""The poses of several frames at once, from all flow between them."""
