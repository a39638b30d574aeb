"""Which motions an image pair holds, and which of them is the camera's."""
