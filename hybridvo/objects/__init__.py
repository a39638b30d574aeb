"""What else moves: objects with their motions, told apart after the camera's motion is known."""
