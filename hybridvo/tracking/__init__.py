"""What a tracker remembers: motion history, key frames and their pose graph, its state."""
