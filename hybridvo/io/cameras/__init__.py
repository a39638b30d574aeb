"""Live cameras: thin drivers that hand out frames, one file for each SDK."""
