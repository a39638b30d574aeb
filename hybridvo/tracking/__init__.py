"""The tracker: one frame in, one step out."""
