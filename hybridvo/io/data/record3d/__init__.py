"""Recordings of the phone app Record3D: what is in the file, and the frames made of it."""
